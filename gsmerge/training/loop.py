"""The training run: AdamW on random crops, validation, checkpoints; killed at any time, it goes on where it was.

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
from gsmerge.networks import Networks, save_checkpoint
from gsmerge.networks.residuals import COLOR, LOGIT, MEAN, RESIDUAL, SIZE, TURN, limits
from gsmerge.threads import parallel_map, use_threads
from gsmerge.training.examples import Example
from gsmerge.training.options import TrainOptions
from gsmerge.training.predict import Crop, predicted, random_crop
from gsmerge.training.record import REMEDY, Learner, Row, load_state, save_state, write_losses

Told = Callable[[int, int, float], None]  # step, steps, loss
PARTS = {"mean": MEAN, "size": SIZE, "turn": TURN, "logit": slice(LOGIT, LOGIT + 1), "color": COLOR}
VALIDATION = 2**32  # instead of the step, in what validation's random numbers hang on
MANY = 4.0  # targets are held within so many standard deviations


@dataclass(frozen=True)
class Trained:
    """What a run left behind.

    Args:
        best: Checkpoint of the least validation loss.
        last: Checkpoint of the last step.
        losses: CSV, one row for each time that it was validated.
        step: Steps done.
        loss: The last training loss.
        validation_loss: The least validation loss.
        resumed: Step that the run went on from; 0 for a new one.
    """

    best: Path
    last: Path
    losses: Path
    step: int
    loss: float
    validation_loss: float
    resumed: int


def train(
    examples: Sequence[Example],
    validation: Sequence[Example],
    out: Path,
    options: TrainOptions | None = None,
    *,
    threads: int | None = None,
    progress: Told | None = None,
) -> Trained:
    """Train networks, or go on with the run that the folder holds.

    Args:
        examples: Scenes to learn from, at least one.
        validation: Scenes that choose the best checkpoint; empty: other crops of the first ones.
        out: Folder for ``best.safetensors``, ``last.safetensors``, ``losses.csv`` and ``state.safetensors``.
        options: Settings.
        threads: Threads to use; None: all processors. The result does not depend on it.
        progress: Called after every step.

    Raises:
        ValueError: If there are no examples.
        SceneError: If the folder holds another run, or cannot be written.
    """
    options = options or TrainOptions()
    if not examples:
        raise ValueError("examples: expected at least one, got none")
    out.mkdir(parents=True, exist_ok=True)
    with use_threads(threads):
        return _run(examples, validation or examples, out, options, progress)


def _run(
    examples: Sequence[Example], validation: Sequence[Example], out: Path, options: TrainOptions, progress: Told | None
) -> Trained:
    learner = _fresh(options)
    scales, crops = target_scales(examples), _validation_crops(validation, options)
    hashes = {kind: [e.sha256 for e in part] for kind, part in (("data", examples), ("validation", validation))}
    step, rows, best = _resumed(out, learner, {"options": options.to_dict(), **hashes})
    resumed, losses = step, list[Tensor]()
    while step < options.steps:
        losses.append(_step(learner, examples, scales, options, step))
        step += 1
        if progress:
            progress(step, options.steps, float(losses[-1]))
        if step % options.save_every == 0 or step == options.steps:
            judged = _judged(learner.smooth, crops, scales, options)
            mean = float(torch.stack(losses).mean())
            rows.append({"step": step, "rate": options.rate_at(step - 1), "loss": mean, **judged})
            losses = []
            told = {"step": step, "loss": mean, "validation": judged, "options": options.to_dict(), **hashes}
            if judged["validation_loss"] < best:
                best = judged["validation_loss"]
                save_checkpoint(out / "best.safetensors", learner.smooth, told)
            save_checkpoint(out / "last.safetensors", learner.smooth, told)
            write_losses(out / "losses.csv", rows)
            state = {"step": step, "rows": rows, "best": best, "options": options.to_dict(), **hashes}
            save_state(out / "state.safetensors", learner, state)
    paths = (out / "best.safetensors", out / "last.safetensors", out / "losses.csv")
    return Trained(*paths, step, rows[-1]["loss"], best, resumed)


def _fresh(options: TrainOptions) -> Learner:
    """New networks that hang on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        networks = Networks(options.network)
    optimizer = torch.optim.AdamW(networks.parameters(), lr=options.rate, weight_decay=options.decay)
    return Learner(networks, deepcopy(networks).requires_grad_(False), optimizer)


def _resumed(out: Path, learner: Learner, wanted: dict[str, Any]) -> tuple[int, list[Row], float]:
    """Step, table and least validation loss of the run in the folder; those of a new one where there is none."""
    path = out / "state.safetensors"
    if not path.exists():
        return 0, [], float("inf")
    told = load_state(path, learner)
    for name, value in wanted.items():
        if told.get(name) != value:
            raise SceneError(path, f"expected a run with the same {name}, found another", REMEDY)
    return int(told["step"]), list(told["rows"]), float(told["best"])


def target_scales(examples: Sequence[Example]) -> dict[int, Tensor]:
    """``[13]`` standard deviation of every column of the targets of each K, at least a thousandth."""
    found = {}
    for k in examples[0].levels:
        levels = [example.levels[k] for example in examples]
        targets = torch.cat([level.targets[level.mask] for level in levels])
        found[k] = targets.std(0, correction=0).clamp_min(1e-3)
    return found


def _validation_crops(validation: Sequence[Example], options: TrainOptions) -> list[Crop]:
    """The crops that validation looks at every time."""
    rng = np.random.default_rng([options.seed, VALIDATION])
    every = [example for example in validation for _ in range(options.validation_crops)]
    return [random_crop(example, options.crop, options.inner, rng) for example in every]


def compared(
    crop: Crop, networks: Networks, scales: Mapping[int, Tensor], options: TrainOptions, seed: int
) -> tuple[Tensor, Tensor]:
    """``[j,13]`` corrections and targets of the judged children, in standard deviations of the targets.

    Targets are held within what the networks can say, and within a few standard deviations.
    """
    targets = crop.example.levels[crop.k].targets[crop.children[crop.judged]]
    most = 2 * limits(options.network.bounds)  # of all stages together
    found = predicted(crop, networks, seed)[crop.judged]
    return found / scales[crop.k], (targets.clamp(-most, most) / scales[crop.k]).clamp(-MANY, MANY)


def correction_loss(found: Tensor, wanted: Tensor, options: TrainOptions) -> Tensor:
    """Mean smooth L1 of corrections ``[j,13]``; 0 of none."""
    weights = torch.ones(RESIDUAL)
    weights[TURN] = options.turn_weight
    losses = torch.nn.functional.smooth_l1_loss(found, wanted, reduction="none") * weights
    return losses.sum() / (weights.sum() * max(1, len(wanted)))


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
            crop = random_crop(example, options.crop, options.inner, rng)
            loss = correction_loss(*compared(crop, networks, scales, options, step), options)
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


def _judged(networks: Networks, crops: Sequence[Crop], scales: Mapping[int, Tensor], options: TrainOptions) -> Row:
    """Validation loss, and the explained share of the targets' squares for each kind of correction."""

    def work(crop: Crop) -> tuple[float, Tensor, Tensor]:
        with torch.no_grad():
            found, wanted = compared(crop, networks, scales, options, 0)
            return (
                float(correction_loss(found, wanted, options)),
                (found - wanted).square().sum(0),
                wanted.square().sum(0),
            )

    losses, left, whole = zip(*parallel_map(work, crops), strict=True)
    missed, squares = torch.stack(left).sum(0), torch.stack(whole).sum(0)
    shares = {
        f"explained_{name}": float(1 - missed[columns].sum() / squares[columns].sum().clamp_min(1e-12))
        for name, columns in PARTS.items()
    }
    return {"validation_loss": float(np.mean(losses)), **shares}
