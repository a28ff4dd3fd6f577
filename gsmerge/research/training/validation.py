"""Validation on fixed crops, windows and whole photos of the validation examples, read one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsmerge.measure.preview import save_picture, to_picture
from gsmerge.networks.corrections import COLOR, LOGIT, MEAN, ROTATION, SIZE
from gsmerge.research.training.examples import Example, draw_views
from gsmerge.research.training.losses import correction_loss, render_window, scaled_corrections, window_psnr
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.predict import predict
from gsmerge.research.training.processes import Processes
from gsmerge.research.training.shards import Shard, read_shard
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Crop, Window, sample_crop, sample_window, whole_photo
from gsmerge.runtime.threads import parallel_map

PARTS = {"mean": MEAN, "size": SIZE, "turn": ROTATION, "logit": slice(LOGIT, LOGIT + 1), "color": COLOR}
VALIDATION = 2**32  # takes the place of the step in the seed of validation's random numbers
Row = dict[str, float]  # of the table of losses
# Of each window: PSNR (dB) without and with networks, and the share that was merged; of each crop: loss, squares of the
# errors [13] and of the targets [13].
Scores = tuple[list[tuple[float, float, float]], list[tuple[float, Tensor, Tensor]]]


@dataclass(frozen=True)
class TrainingRun:
    """Settings that every step of a run reads."""

    options: TrainOptions
    scales: Mapping[int, Tensor]  # of the targets of each K; empty where no loss uses a fit
    processes: Processes


def validate(networks: Networks, shards: Sequence[Shard], run: TrainingRun, out: Path) -> Row:
    """Measure the PSNR of renders without and with networks, and the share of Feature Gaussians that these merged.

    Where a loss uses the fit, also the loss of corrections, and the explained share of the targets' squares for each
    kind of correction. A ``validation-NAME.png`` for each scene shows a photo, its analytic and its learned render.
    """
    scores = [_score(networks, shards, i, run, out) for i in run.processes.share(range(len(shards)))]
    every = run.processes.gather(scores)
    analytic, learned, matched = np.mean([window for windows, _ in every for window in windows], 0).tolist()
    row = {"psnr_analytic": analytic, "psnr_learned": learned, "matched": matched}
    crops = [crop for _, some in every for crop in some]
    if not crops:
        return row
    losses, errors, squares = zip(*crops, strict=True)
    missed, whole = torch.stack(errors).sum(0), torch.stack(squares).sum(0)
    shares = {
        f"explained_{name}": float(1 - missed[columns].sum() / whole[columns].sum().clamp_min(1e-12))
        for name, columns in PARTS.items()
    }
    return {"validation_loss": float(np.mean(losses)), **row, **shares}


def _score(networks: Networks, shards: Sequence[Shard], number: int, run: TrainingRun, out: Path) -> Scores:
    """Score one of the shards, and write its picture if it is the first of its scene."""
    options = run.options
    example, rng = read_shard(shards[number]), np.random.default_rng([options.seed, VALIDATION, number])
    windows = [
        sample_window(draw_views(example, options, rng), options.levels, options.window, options.most, 1, rng)
        for _ in range(options.validation_windows)
    ]
    num_crops = options.validation_crops if options.uses_fit else 0
    crops = [sample_crop(example, options.levels, options.crop, options.inner, rng) for _ in range(num_crops)]

    def score_window(window: Window) -> tuple[float, float, float]:
        plain, _ = render_window(window, None, options)
        image, matched = render_window(window, networks, options)
        return window_psnr(window, plain), window_psnr(window, image), matched

    def score_crop(crop: Crop) -> tuple[float, Tensor, Tensor]:
        with torch.no_grad():
            prediction = predict(crop, networks, options, 0)
            corrections, targets = scaled_corrections(crop, prediction, run.scales, options)
            loss = float(correction_loss(corrections, targets, options))
            return loss, (corrections - targets).square().sum(0), targets.square().sum(0)

    if shards[number].scene not in {shard.scene for shard in shards[:number]}:
        _write_picture(out / f"validation-{example.name}.png", networks, example, options)
    return parallel_map(score_window, windows), parallel_map(score_crop, crops)


def _write_picture(path: Path, networks: Networks, example: Example, options: TrainOptions) -> None:
    """Draw a photo, novel if there is one, its analytic render and its learned render side by side."""
    ids = [*example.photo_ids(novel=True), *example.photo_ids(novel=False), 0]
    window = whole_photo(example, ids[0], min(options.levels))
    renders = [render_window(window, chosen, options)[0] for chosen in (None, networks)]
    row = torch.cat([window.image, *renders], 1)
    save_picture(path, to_picture(row.numpy()))
