"""Validation: always the same crops, windows and whole photos of the validation examples, read one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from gsmerge.io.atomic import atomic_output
from gsmerge.networks.modules import Networks
from gsmerge.networks.residuals import COLOR, LOGIT, MEAN, ROTATION, SIZE
from gsmerge.research.training.examples import Example, draw_views
from gsmerge.research.training.losses import correction_loss, render_window, scaled_corrections, window_psnr
from gsmerge.research.training.predict import predict
from gsmerge.research.training.processes import Processes
from gsmerge.research.training.shards import Shard, read_shard
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Crop, Window, sample_crop, sample_window, whole_photo
from gsmerge.runtime.threads import parallel_map

PARTS = {"mean": MEAN, "size": SIZE, "turn": ROTATION, "logit": slice(LOGIT, LOGIT + 1), "color": COLOR}
VALIDATION = 2**32  # takes the place of the step in the seed of validation's random numbers
Row = dict[str, float]  # of the table of losses


@dataclass(frozen=True, eq=False)
class ExampleScores:
    """Scores of one validation example."""

    windows: list[tuple[float, float, float]]  # PSNR (dB) without and with networks, share that was merged
    crops: list[tuple[float, Tensor, Tensor]]  # loss, squares of the errors [13] and of the targets [13]


def validate(
    networks: Networks,
    shards: Sequence[Shard],
    scales: Mapping[int, Tensor],
    options: TrainOptions,
    out: Path,
    processes: Processes,
) -> Row:
    """PSNR of renders without and with networks, and the share of Feature Gaussians that these merged.

    Where a loss uses the fit, also the loss of corrections, and the explained share of the targets' squares for each
    kind of correction. A ``validation-NAME.png`` for each scene shows a photo, its analytic and its learned render.
    """
    scores = [_score(networks, shards, i, scales, options, out) for i in processes.share(range(len(shards)))]
    every = processes.gather(scores)
    analytic, learned, matched = np.mean([window for score in every for window in score.windows], 0).tolist()
    row = {"psnr_analytic": analytic, "psnr_learned": learned, "matched": matched}
    crops = [crop for score in every for crop in score.crops]
    if not crops:
        return row
    losses, errors, squares = zip(*crops, strict=True)
    missed, whole = torch.stack(errors).sum(0), torch.stack(squares).sum(0)
    shares = {
        f"explained_{name}": float(1 - missed[columns].sum() / whole[columns].sum().clamp_min(1e-12))
        for name, columns in PARTS.items()
    }
    return {"validation_loss": float(np.mean(losses)), **row, **shares}


def _score(
    networks: Networks, shards: Sequence[Shard], number: int, scales: Mapping[int, Tensor], options: TrainOptions,
    out: Path,
) -> ExampleScores:  # fmt: skip
    """Scores of one of the shards, and its picture if it is the first of its scene."""
    example, rng = read_shard(shards[number]), np.random.default_rng([options.seed, VALIDATION, number])
    windows = [_window(draw_views(example, options, rng), options, rng) for _ in range(options.validation_windows)]
    num_crops = options.validation_crops if options.uses_fit else 0
    crops = [sample_crop(example, options.levels, options.crop, options.inner, rng) for _ in range(num_crops)]

    def score_window(window: Window) -> tuple[float, float, float]:
        plain, _ = render_window(window, None, options)
        image, matched = render_window(window, networks, options)
        return window_psnr(window, plain), window_psnr(window, image), matched

    def score_crop(crop: Crop) -> tuple[float, Tensor, Tensor]:
        with torch.no_grad():
            prediction = predict(crop, networks, options, 0)
            corrections, targets = scaled_corrections(crop, prediction.corrections, scales, options)
            loss = float(correction_loss(corrections, targets, options))
            return loss, (corrections - targets).square().sum(0), targets.square().sum(0)

    if shards[number].scene not in {shard.scene for shard in shards[:number]}:
        _write_picture(out / f"validation-{example.name}.png", networks, example, options)
    return ExampleScores(parallel_map(score_window, windows), parallel_map(score_crop, crops))


def _window(example: Example, options: TrainOptions, rng: np.random.Generator) -> Window:
    """In a novel view if there is one."""
    return sample_window(example, options.levels, options.window, options.most, 1, rng)


def _write_picture(path: Path, networks: Networks, example: Example, options: TrainOptions) -> None:
    """A photo, novel if there is one, its analytic render and its learned render side by side."""
    ids = [*example.photo_ids(novel=True), *example.photo_ids(novel=False), 0]
    window = whole_photo(example, ids[0], min(options.levels))
    renders = [render_window(window, chosen, options)[0] for chosen in (None, networks)]
    row = torch.cat([window.image, *renders], 1)
    _, data = cv2.imencode(".png", (row.clamp(0, 1) * 255).round().byte().numpy()[..., ::-1])
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(data.tobytes())
