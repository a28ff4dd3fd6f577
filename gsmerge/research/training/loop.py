"""The training run: AdamW on random crops, validation, checkpoints; killed at any time, it goes on where it was.

The first steps, if so wanted, learn from what the fit changed alone. Regression to a mean overshoots what is ambiguous,
so all others compare renders with photos.

Every random number hangs on the seed and the step, and crops are worked on alone and added up in order. So a run that
was interrupted ends with the same bytes as one that was not, on any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.measure.lpips import require_lpips
from gsmerge.networks import Networks, save_checkpoint
from gsmerge.research.training.examples import Example
from gsmerge.research.training.objective import compared, correction_loss, target_scales, window_loss
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.predict import random_crop
from gsmerge.research.training.record import REMEDY, Learner, Row, load_state, save_state, write_losses
from gsmerge.research.training.validation import judged_by, make_judge, write_pictures
from gsmerge.research.training.windows import random_window
from gsmerge.runtime.threads import parallel_map, use_threads

Told = Callable[[int, int, float], None]  # step, steps, loss


@dataclass(frozen=True)
class Trained:
    """What a run left behind.

    Args:
        best: Checkpoint of the highest PSNR of validation since renders are compared; before, of the least loss.
        last: Checkpoint of the last step.
        losses: CSV, one row for each time that it was validated.
        step: Steps done.
        loss: The last training loss.
        validation_loss: The least validation loss.
        psnr_analytic: PSNR (dB) of the windows of validation without networks.
        psnr_learned: The best with them.
        resumed: Step that the run went on from; 0 for a new one.
    """

    best: Path
    last: Path
    losses: Path
    step: int
    loss: float
    validation_loss: float
    psnr_analytic: float
    psnr_learned: float
    resumed: int


def train(
    examples: Sequence[Example],
    validation: Sequence[Example],
    out: Path,
    options: TrainOptions | None = None,
    *,
    threads: int | None = None,
    device: str = "cpu",
    progress: Told | None = None,
) -> Trained:
    """Train networks, or go on with the run that the folder holds.

    Args:
        examples: Scenes to learn from, at least one.
        validation: Scenes that choose the best checkpoint; empty: other crops of the first ones.
        out: Folder for ``best.safetensors``, ``last.safetensors``, ``losses.csv``, ``state.safetensors`` and a picture
            of each validation scene.
        options: Settings.
        threads: Threads to use; None: all processors. The result does not depend on it.
        device: Where the networks run: ``"cpu"``, ``"cuda"``, or ``"auto"``, CUDA where torch finds it. Windows are
            rendered on the CPU. On CUDA a run repeats to rounding, not to the bit.
        progress: Called after every step.

    Raises:
        ValueError: If there are no examples, or torch finds no CUDA device and is told to use it.
        GsmergeError: If LPIPS has a weight, and its own are not installed.
        SceneError: If the folder holds another run, or cannot be written.
    """
    options = options or TrainOptions()
    if not examples:
        raise ValueError("examples: expected at least one, got none")
    if options.lpips_weight:
        require_lpips("vgg")
    out.mkdir(parents=True, exist_ok=True)
    with use_threads(threads):
        return _run(examples, validation or examples, out, options, network_device(device), progress)


def network_device(wanted: str) -> str:
    """The device that ``"cpu"``, ``"cuda"`` or ``"auto"`` means on this machine.

    Raises:
        ValueError: If the name is unknown, or torch finds no CUDA device and it is wanted.
    """
    if wanted not in ("cpu", "cuda", "auto"):
        raise ValueError(f'device: expected "cpu", "cuda" or "auto", got {wanted!r}')
    found = wanted != "cpu" and torch.cuda.is_available()
    if wanted == "cuda" and not found:
        raise ValueError('device: expected a CUDA device, torch finds none; use "cpu"')
    return "cuda" if found else "cpu"


def _run(
    examples: Sequence[Example],
    validation: Sequence[Example],
    out: Path,
    options: TrainOptions,
    device: str,
    progress: Told | None,
) -> Trained:
    learner = _fresh(options, device)
    scales, judge = target_scales(examples), make_judge(validation, options)
    hashes = {kind: [e.sha256 for e in part] for kind, part in (("data", examples), ("validation", validation))}
    step, rows = _resumed(out, learner, {"options": options.to_dict(), **hashes})
    resumed, losses = step, list[Tensor]()
    while step < options.steps:
        losses.append(_step(learner, examples, scales, options, step))
        step += 1
        if progress:
            progress(step, options.steps, float(losses[-1]))
        if step % options.save_every == 0 or step == options.steps:
            judged = judged_by(learner.smooth, judge, scales, options)
            mean = float(torch.stack(losses).mean())
            rows.append({"step": step, "rate": options.rate_at(step - 1), "loss": mean, **judged})
            losses = []
            told = {"step": step, "loss": mean, "figures": judged, "options": options.to_dict(), **hashes}
            if is_best(rows, options):
                save_checkpoint(out / "best.safetensors", learner.smooth, told)
            save_checkpoint(out / "last.safetensors", learner.smooth, told)
            write_losses(out / "losses.csv", rows)
            write_pictures(out, learner.smooth, judge)
            state = {"step": step, "rows": rows, "options": options.to_dict(), **hashes}
            save_state(out / "state.safetensors", learner, state)
    paths = (out / "best.safetensors", out / "last.safetensors", out / "losses.csv")
    least, most = min(row["validation_loss"] for row in rows), max(row["psnr_learned"] for row in rows)
    return Trained(*paths, step, rows[-1]["loss"], least, rows[-1]["psnr_analytic"], most, resumed)


def is_best(rows: Sequence[Row], options: TrainOptions) -> bool:
    """Whether the last row is better than all before it: those that compared renders, as soon as one did."""
    *before, last = rows
    if last["step"] > options.photo_step:
        earlier = [row["psnr_learned"] for row in before if row["step"] > options.photo_step]
        return last["psnr_learned"] > max(earlier, default=-float("inf"))
    return last["validation_loss"] < min((row["validation_loss"] for row in before), default=float("inf"))


def _fresh(options: TrainOptions, device: str) -> Learner:
    """New networks that hang on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        networks = Networks(options.network).to(device)
    optimizer = torch.optim.AdamW(networks.parameters(), lr=options.rate, weight_decay=options.decay)
    return Learner(networks, deepcopy(networks).requires_grad_(False), optimizer)


def _resumed(out: Path, learner: Learner, wanted: dict[str, Any]) -> tuple[int, list[Row]]:
    """Step and table of the run in the folder; those of a new one where there is none."""
    path = out / "state.safetensors"
    if not path.exists():
        return 0, []
    told = load_state(path, learner)
    for name, value in wanted.items():
        if told.get(name) != value:
            raise SceneError(path, f"expected a run with the same {name}, found another", REMEDY)
    return int(told["step"]), list(told["rows"])


def _step(
    learner: Learner,
    examples: Sequence[Example],
    scales: Mapping[int, Tensor],
    options: TrainOptions,
    step: int,
) -> Tensor:
    """One step -> its loss."""
    networks, optimizer = learner.networks, learner.optimizer
    parameters = list(networks.parameters())

    def work(index: int) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        rng = np.random.default_rng([options.seed, step, index])
        example = examples[int(rng.integers(len(examples)))]
        with torch.enable_grad():
            if step < options.photo_step:
                crop = random_crop(example, options.crop, options.inner, rng)
                loss = correction_loss(*compared(crop, networks, scales, options, step), options)
            else:
                window = random_window(example, options.window, options.most, options.novel, rng)
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
        for _, parameter, mean in learner.pairs():
            mean.lerp_(parameter, 1 - share)
    return torch.stack(losses).mean()
