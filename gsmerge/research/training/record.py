"""What a training run leaves: a table of losses, and a state that it can go on from after being killed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch.nn import Parameter

from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.networks import Networks

FORMAT = "gsmerge-training"
REMEDY = "choose another --output, or remove it to begin anew"
Row = dict[str, float]


@dataclass(frozen=True, eq=False)
class Learner:
    """What a step changes: networks, the running mean of their weights, and the optimiser's moments."""

    networks: Networks
    smooth: Networks
    optimizer: torch.optim.Optimizer

    def pairs(self) -> Iterator[tuple[str, Parameter, Parameter]]:
        """Name, parameter, and its running mean."""
        for (name, parameter), mean in zip(self.networks.named_parameters(), self.smooth.parameters(), strict=True):
            yield name, parameter, mean


def save_state(path: Path, learner: Learner, told: Mapping[str, Any]) -> None:
    """Write weights, their means, moments and what else the run knows; an existing file is replaced."""
    tensors: dict[str, torch.Tensor] = {}
    for name, parameter, mean in learner.pairs():
        moments = learner.optimizer.state[parameter]
        named = {"weight": parameter, "mean": mean, "first": moments["exp_avg"], "second": moments["exp_avg_sq"]}
        tensors |= {f"{kind}.{name}": tensor.detach().cpu() for kind, tensor in named.items()}
    with atomic_output(path, overwrite=True) as temporary:
        save_file(tensors, temporary, {FORMAT: json.dumps(dict(told))})


def load_state(path: Path, learner: Learner) -> dict[str, Any]:
    """Put weights, means and moments back, in place; returns what else was written.

    Raises:
        SceneError: If the file is damaged or of other networks.
    """
    try:
        with safe_open(path, "pt") as file:
            told = json.loads((file.metadata() or {})[FORMAT])
            with torch.no_grad():
                for name, parameter, mean in learner.pairs():
                    parameter.copy_(file.get_tensor(f"weight.{name}"))
                    mean.copy_(file.get_tensor(f"mean.{name}"))
                    kept = (file.get_tensor(f"{kind}.{name}") for kind in ("first", "second"))
                    first, second = (tensor.to(parameter.device) for tensor in kept)
                    step = torch.tensor(float(told["step"]))
                    learner.optimizer.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise SceneError(
            path, "expected the state of a training run, found a damaged file or another", REMEDY
        ) from error
    return dict(told)


def write_losses(path: Path, rows: Sequence[Row]) -> None:
    """Write the table of losses as CSV; an existing file is replaced."""
    lines = [",".join(rows[0])] if rows else []
    lines += [",".join(f"{value:.8g}" for value in row.values()) for row in rows]
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
