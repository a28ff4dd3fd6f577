"""The training run: AdamW on random crops, validation, checkpoints; an interrupted run can be resumed.

The first steps can learn from the corrections of the fit alone. Regression overshoots where the corrections are
ambiguous, so all other steps compare renders with photos.

Random numbers depend only on seed and step, and the gradients of crops are added in order. So an interrupted run ends
with the same bytes as one that was not, on any number of threads.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import Parameter

from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.measure.lpips import require_lpips
from gsmerge.networks import Networks, save_checkpoint
from gsmerge.research.training.examples import Example
from gsmerge.research.training.losses import correction_loss, scaled_corrections, target_scales, window_loss
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.predict import sample_crop
from gsmerge.research.training.validation import Row, make_validation_set, validate, write_pictures
from gsmerge.research.training.windows import sample_window
from gsmerge.runtime.threads import parallel_map, use_threads

Progress = Callable[[int, int, float], None]  # step, steps, loss
FORMAT = "gsmerge-training"
REMEDY = "choose another --output, or remove it to start again"


@dataclass(frozen=True, eq=False)
class TrainingState:
    """Networks, the running mean of their weights, and the optimiser's moments: everything that a step changes."""

    networks: Networks
    smooth: Networks
    optimizer: torch.optim.Optimizer

    def pairs(self) -> Iterator[tuple[str, Parameter, Parameter]]:
        """Name, parameter, and its running mean."""
        for (name, parameter), mean in zip(self.networks.named_parameters(), self.smooth.parameters(), strict=True):
            yield name, parameter, mean


@dataclass(frozen=True)
class TrainResult:
    """The files and figures of a run."""

    best: Path  # checkpoint with the highest PSNR of validation; before renders are compared, with the least loss
    last: Path  # checkpoint of the last step
    losses: Path  # CSV, one row for each validation
    step: int  # steps done
    loss: float  # the last training loss
    validation_loss: float  # the least validation loss
    psnr_analytic: float  # PSNR (dB) of the windows of validation without networks
    psnr_learned: float  # the best PSNR with networks
    resumed: int  # step from which the run was resumed; 0 for a new one


def train(
    examples: Sequence[Example],
    validation: Sequence[Example],
    out: Path,
    options: TrainOptions | None = None,
    *,
    threads: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> TrainResult:
    """Train networks, or resume the run in the folder.

    Args:
        examples: Scenes to learn from, at least one.
        validation: Scenes that choose the best checkpoint; empty: other crops of the first ones.
        out: Folder for ``best.safetensors``, ``last.safetensors``, ``losses.csv``, ``state.safetensors`` and a picture
            of each validation scene.
        options: Settings.
        threads: Threads to use; None: all processors. The result does not depend on it.
        device: Where the networks run: ``"cpu"``, ``"cuda"``, or ``"auto"``: CUDA if torch finds it. Windows are
            rendered on the CPU. On CUDA a run repeats up to rounding, not to the bit.
        progress: Called after every step.

    Raises:
        ValueError: If there are no examples, or torch finds no CUDA device and ``device`` asks for it.
        GsmergeError: If LPIPS has a weight, and its networks are not installed.
        SceneError: If the folder holds another run, or cannot be written.
    """
    options = options or TrainOptions()
    if not examples:
        raise ValueError("examples: expected at least one, got none")
    if options.lpips_weight:
        require_lpips("vgg")
    out.mkdir(parents=True, exist_ok=True)
    with use_threads(threads):
        return _run(examples, validation or examples, out, options, choose_device(device), progress)


def choose_device(name: str) -> str:
    """The device that ``"cpu"``, ``"cuda"`` or ``"auto"`` means on this machine.

    Raises:
        ValueError: If the name is unknown, or is "cuda" and torch finds no CUDA device.
    """
    if name not in ("cpu", "cuda", "auto"):
        raise ValueError(f'device: expected "cpu", "cuda" or "auto", got {name!r}')
    has_cuda = name != "cpu" and torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise ValueError('device: expected a CUDA device, torch finds none; use "cpu"')
    return "cuda" if has_cuda else "cpu"


def _run(
    examples: Sequence[Example],
    validation: Sequence[Example],
    out: Path,
    options: TrainOptions,
    device: str,
    progress: Progress | None,
) -> TrainResult:
    state = _new_state(options, device)
    scales, validation_set = target_scales(examples), make_validation_set(validation, options)
    hashes = {kind: [e.sha256 for e in part] for kind, part in (("data", examples), ("validation", validation))}
    step, rows = _resume(out, state, {"options": options.to_dict(), **hashes})
    resumed, losses = step, list[Tensor]()
    while step < options.steps:
        losses.append(_step(state, examples, scales, options, step))
        step += 1
        if progress:
            progress(step, options.steps, float(losses[-1]))
        if step % options.save_every == 0 or step == options.steps:
            scores = validate(state.smooth, validation_set, scales, options)
            mean = float(torch.stack(losses).mean())
            rows.append({"step": step, "rate": options.rate_at(step - 1), "loss": mean, **scores})
            losses = []
            training = {"step": step, "loss": mean, "figures": scores, "options": options.to_dict(), **hashes}
            if is_best(rows, options):
                save_checkpoint(out / "best.safetensors", state.smooth, training)
            save_checkpoint(out / "last.safetensors", state.smooth, training)
            write_losses(out / "losses.csv", rows)
            write_pictures(out, state.smooth, validation_set)
            facts = {"step": step, "rows": rows, "options": options.to_dict(), **hashes}
            save_state(out / "state.safetensors", state, facts)
    paths = (out / "best.safetensors", out / "last.safetensors", out / "losses.csv")
    least, most = min(row["validation_loss"] for row in rows), max(row["psnr_learned"] for row in rows)
    return TrainResult(*paths, step, rows[-1]["loss"], least, rows[-1]["psnr_analytic"], most, resumed)


def is_best(rows: Sequence[Row], options: TrainOptions) -> bool:
    """Whether the last row is the best: of the rows that compared renders, if it did."""
    *before, last = rows
    if last["step"] > options.photo_step:
        earlier = [row["psnr_learned"] for row in before if row["step"] > options.photo_step]
        return last["psnr_learned"] > max(earlier, default=-float("inf"))
    return last["validation_loss"] < min((row["validation_loss"] for row in before), default=float("inf"))


def _new_state(options: TrainOptions, device: str) -> TrainingState:
    """New networks, which depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        networks = Networks(options.network).to(device)
    optimizer = torch.optim.AdamW(networks.parameters(), lr=options.rate, weight_decay=options.decay)
    return TrainingState(networks, deepcopy(networks).requires_grad_(False), optimizer)


def _resume(out: Path, state: TrainingState, expected: dict[str, Any]) -> tuple[int, list[Row]]:
    """Step and table of losses of the run in the folder; those of a new run if there is none."""
    path = out / "state.safetensors"
    if not path.exists():
        return 0, []
    facts = load_state(path, state)
    for name, value in expected.items():
        if facts.get(name) != value:
            raise SceneError(path, f"expected a run with the same {name}, found another", REMEDY)
    return int(facts["step"]), list(facts["rows"])


def _step(
    state: TrainingState,
    examples: Sequence[Example],
    scales: Mapping[int, Tensor],
    options: TrainOptions,
    step: int,
) -> Tensor:
    """Do one step; returns its loss."""
    networks, optimizer = state.networks, state.optimizer
    parameters = list(networks.parameters())

    def work(index: int) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        rng = np.random.default_rng([options.seed, step, index])
        example = examples[int(rng.integers(len(examples)))]
        with torch.enable_grad():
            if step < options.photo_step:
                crop = sample_crop(example, options.crop, options.inner, rng)
                loss = correction_loss(*scaled_corrections(crop, networks, scales, options, step), options)
            else:
                window = sample_window(example, options.window, options.most, options.novel, rng)
                loss = window_loss(networks, window, scales, options, step, rng)
            return loss.detach(), torch.autograd.grad(loss, parameters, allow_unused=True)

    losses, gradients = zip(*parallel_map(work, range(options.crops)), strict=True)
    for parameter, parts in zip(parameters, zip(*gradients, strict=True), strict=True):
        known = [part for part in parts if part is not None]
        parameter.grad = torch.stack(known).sum(0) / options.crops if known else torch.zeros_like(parameter)
    torch.nn.utils.clip_grad_norm_(parameters, options.clip)
    for group in optimizer.param_groups:
        group["lr"] = options.rate_at(step)
    optimizer.step()
    share = min(options.average, (1 + step) / (10 + step))
    with torch.no_grad():
        for _, parameter, mean in state.pairs():
            mean.lerp_(parameter, 1 - share)
    return torch.stack(losses).mean()


def save_state(path: Path, state: TrainingState, facts: Mapping[str, Any]) -> None:
    """Write weights, their means, moments and facts about the run; an existing file is replaced."""
    tensors: dict[str, torch.Tensor] = {}
    for name, parameter, mean in state.pairs():
        moments = state.optimizer.state[parameter]
        named = {"weight": parameter, "mean": mean, "first": moments["exp_avg"], "second": moments["exp_avg_sq"]}
        tensors |= {f"{kind}.{name}": tensor.detach().cpu() for kind, tensor in named.items()}
    with atomic_output(path, overwrite=True) as temporary:
        save_file(tensors, temporary, {FORMAT: json.dumps(dict(facts))})


def load_state(path: Path, state: TrainingState) -> dict[str, Any]:
    """Read weights, means and moments into ``state``; returns the facts about the run.

    Raises:
        SceneError: If the file is damaged or of other networks.
    """
    try:
        with safe_open(path, "pt") as file:
            facts = json.loads((file.metadata() or {})[FORMAT])
            with torch.no_grad():
                for name, parameter, mean in state.pairs():
                    parameter.copy_(file.get_tensor(f"weight.{name}"))
                    mean.copy_(file.get_tensor(f"mean.{name}"))
                    kept = (file.get_tensor(f"{kind}.{name}") for kind in ("first", "second"))
                    first, second = (tensor.to(parameter.device) for tensor in kept)
                    step = torch.tensor(float(facts["step"]))
                    state.optimizer.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise SceneError(
            path, "expected the state of a training run, found a damaged file or another", REMEDY
        ) from error
    return dict(facts)


def write_losses(path: Path, rows: Sequence[Row]) -> None:
    """Write the table of losses as CSV; an existing file is replaced."""
    lines = [",".join(rows[0])] if rows else []
    lines += [",".join(f"{value:.8g}" for value in row.values()) for row in rows]
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
