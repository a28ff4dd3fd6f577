"""What a training run leaves: a table of losses, and a state that it can go on from after being killed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.networks import Networks

FORMAT = "gsmerge-training"
REMEDY = "choose another --out, or remove it to begin anew"
Row = dict[str, float]


def save_state(path: Path, networks: Networks, optimizer: torch.optim.Optimizer, told: Mapping[str, Any]) -> None:
    """Write weights, moments and what else the run knows; an existing file is replaced."""
    tensors = {}
    for name, parameter in networks.named_parameters():
        tensors[f"weight.{name}"] = parameter.detach()
        moments = optimizer.state[parameter]
        tensors[f"first.{name}"], tensors[f"second.{name}"] = moments["exp_avg"], moments["exp_avg_sq"]
    with atomic_output(path, overwrite=True) as temporary:
        save_file(tensors, temporary, {FORMAT: json.dumps(dict(told))})


def load_state(path: Path, networks: Networks, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Put weights and moments back, in place; returns what else was written.

    Raises:
        SceneError: If the file is damaged or of other networks.
    """
    try:
        with safe_open(path, "pt") as file:
            told = json.loads((file.metadata() or {})[FORMAT])
            with torch.no_grad():
                for name, parameter in networks.named_parameters():
                    weight, first, second = (
                        file.get_tensor(f"{kind}.{name}") for kind in ("weight", "first", "second")
                    )
                    parameter.copy_(weight)
                    step = torch.tensor(float(told["step"]))
                    optimizer.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
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
