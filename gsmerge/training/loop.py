"""The training run: AdamW on random crops, validation, checkpoints; killed at any time, it goes on where it was.

The first steps learn from what the fit changed. Regression to a mean overshoots what is ambiguous, so later ones
compare renders with photos.

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
from gsmerge.perceptual import require_lpips
from gsmerge.threads import parallel_map, use_threads
from gsmerge.training.examples import Example
from gsmerge.training.options import TrainOptions
from gsmerge.training.photometric import draw_window, photometric_loss, window_psnr
from gsmerge.training.predict import Crop, foreseen, predicted, random_crop
from gsmerge.training.record import REMEDY, Learner, Row, load_state, save_state, write_losses
from gsmerge.training.windows import Window, random_window

Told = Callable[[int, int, float], None]  # step, steps, loss
PARTS = {"mean": MEAN, "size": SIZE, "turn": TURN, "logit": slice(LOGIT, LOGIT + 1), "color": COLOR}
VALIDATION = 2**32  # instead of the step, in what validation's random numbers hang on
MANY = 4.0  # targets are held within so many standard deviations


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
        return _run(examples, validation or examples, out, options, progress)


def _run(
    examples: Sequence[Example], validation: Sequence[Example], out: Path, options: TrainOptions, progress: Told | None
) -> Trained:
    learner = _fresh(options)
    scales, judge = target_scales(examples), _judge(validation, options)
    hashes = {kind: [e.sha256 for e in part] for kind, part in (("data", examples), ("validation", validation))}
    step, rows = _resumed(out, learner, {"options": options.to_dict(), **hashes})
    resumed, losses = step, list[Tensor]()
    while step < options.steps:
        losses.append(_step(learner, examples, scales, options, step))
        step += 1
        if progress:
            progress(step, options.steps, float(losses[-1]))
        if step % options.save_every == 0 or step == options.steps:
            judged = _judged(learner.smooth, judge, scales, options)
            mean = float(torch.stack(losses).mean())
            rows.append({"step": step, "rate": options.rate_at(step - 1), "loss": mean, **judged})
            losses = []
            told = {"step": step, "loss": mean, "validation": judged, "options": options.to_dict(), **hashes}
            if _is_best(rows, options):
                save_checkpoint(out / "best.safetensors", learner.smooth, told)
            save_checkpoint(out / "last.safetensors", learner.smooth, told)
            write_losses(out / "losses.csv", rows)
            state = {"step": step, "rows": rows, "options": options.to_dict(), **hashes}
            save_state(out / "state.safetensors", learner, state)
    paths = (out / "best.safetensors", out / "last.safetensors", out / "losses.csv")
    least, most = min(row["validation_loss"] for row in rows), max(row["psnr_learned"] for row in rows)
    return Trained(*paths, step, rows[-1]["loss"], least, rows[-1]["psnr_analytic"], most, resumed)


def _is_best(rows: Sequence[Row], options: TrainOptions) -> bool:
    """Whether the last row is better than all before it: those that compared renders, as soon as one did."""
    *before, last = rows
    if last["step"] > options.photo_step:
        earlier = [row["psnr_learned"] for row in before if row["step"] > options.photo_step]
        return last["psnr_learned"] > max(earlier, default=-float("inf"))
    return last["validation_loss"] < min((row["validation_loss"] for row in before), default=float("inf"))


def _fresh(options: TrainOptions) -> Learner:
    """New networks that hang on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        networks = Networks(options.network)
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


def target_scales(examples: Sequence[Example]) -> dict[int, Tensor]:
    """``[13]`` standard deviation of every column of the targets of each K, at least a thousandth."""
    found = {}
    for k in examples[0].levels:
        levels = [example.levels[k] for example in examples]
        targets = torch.cat([level.targets[level.mask] for level in levels])
        found[k] = targets.std(0, correction=0).clamp_min(1e-3)
    return found


@dataclass(frozen=True)
class Judge:
    """What validation looks at every time: crops, and windows with the PSNR (dB) that they have without networks."""

    crops: list[Crop]
    windows: list[Window]
    analytic: float


def _judge(validation: Sequence[Example], options: TrainOptions) -> Judge:
    """Crops and, where there are novel views, windows of those."""
    rng = np.random.default_rng([options.seed, VALIDATION])
    every = [example for example in validation for _ in range(options.validation_crops)]
    crops = [random_crop(example, options.crop, options.inner, rng) for example in every]
    every = [example for example in validation for _ in range(options.validation_windows)]
    windows = [random_window(example, options.window, options.most, 1, rng) for example in every]
    scores = parallel_map(lambda window: window_psnr(window, None), windows)
    return Judge(crops, windows, float(np.mean(scores)))


def compared(
    crop: Crop, networks: Networks, scales: Mapping[int, Tensor], options: TrainOptions, seed: int
) -> tuple[Tensor, Tensor]:
    """``[j,13]`` corrections and targets of the judged children, in standard deviations of the targets.

    Targets are held within what the networks can say, and within a few standard deviations.
    """
    return _scaled(crop, predicted(crop, networks, seed), scales, options)


def _scaled(
    crop: Crop, corrections: Tensor, scales: Mapping[int, Tensor], options: TrainOptions
) -> tuple[Tensor, Tensor]:
    """:func:`compared` of corrections ``[n,13]`` that are known."""
    targets = crop.example.levels[crop.k].targets[crop.children[crop.judged]]
    most = 2 * limits(options.network.bounds)  # of all stages together
    found = corrections[crop.judged]
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
            if step < options.photo_step:
                crop = random_crop(example, options.crop, options.inner, rng)
                loss = correction_loss(*compared(crop, networks, scales, options, step), options)
            else:
                loss = _photo_loss(networks, example, scales, options, step, rng)
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


def _photo_loss(
    networks: Networks,
    example: Example,
    scales: Mapping[int, Tensor],
    options: TrainOptions,
    step: int,
    rng: np.random.Generator,
) -> Tensor:
    """Loss of a random window of a photo: its render on a random background, and the regression of what is in it."""
    window = random_window(example, options.window, options.most, options.novel, rng)
    found = foreseen(window.crop, networks, step)
    image = draw_window(found.gaussians, window, rng.random(3, dtype=np.float32))
    regression = correction_loss(*_scaled(window.crop, found.corrections, scales, options), options)
    return photometric_loss(image, window, options) + options.regression_at(step) * regression


def _judged(networks: Networks, judge: Judge, scales: Mapping[int, Tensor], options: TrainOptions) -> Row:
    """Validation loss, PSNR of renders, and the explained share of the targets' squares for each kind of correction."""

    def work(crop: Crop) -> tuple[float, Tensor, Tensor]:
        with torch.no_grad():
            found, wanted = compared(crop, networks, scales, options, 0)
            return (
                float(correction_loss(found, wanted, options)),
                (found - wanted).square().sum(0),
                wanted.square().sum(0),
            )

    losses, left, whole = zip(*parallel_map(work, judge.crops), strict=True)
    missed, squares = torch.stack(left).sum(0), torch.stack(whole).sum(0)
    shares = {
        f"explained_{name}": float(1 - missed[columns].sum() / squares[columns].sum().clamp_min(1e-12))
        for name, columns in PARTS.items()
    }
    learned = float(np.mean(parallel_map(lambda window: window_psnr(window, networks), judge.windows)))
    scores = {"psnr_analytic": judge.analytic, "psnr_learned": learned}
    return {"validation_loss": float(np.mean(losses)), **scores, **shares}
