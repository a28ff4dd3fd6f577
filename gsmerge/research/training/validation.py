"""Validation: always the same crops, windows and whole photos of the validation scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from gsmerge.io.atomic import atomic_output
from gsmerge.networks import Networks
from gsmerge.networks.residuals import COLOR, LOGIT, MEAN, ROTATION, SIZE
from gsmerge.research.training.examples import Example
from gsmerge.research.training.losses import correction_loss, render_window, scaled_corrections, window_psnr
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.predict import Crop, sample_crop
from gsmerge.research.training.windows import Window, sample_window, whole_photo
from gsmerge.runtime.threads import parallel_map

PARTS = {"mean": MEAN, "size": SIZE, "turn": ROTATION, "logit": slice(LOGIT, LOGIT + 1), "color": COLOR}
VALIDATION = 2**32  # takes the place of the step in the seed of validation's random numbers
Row = dict[str, float]  # of the table of losses


@dataclass(frozen=True, eq=False)
class ValidationSet:
    """What is compared in every validation."""

    crops: list[Crop]  # whose corrections are compared with those of the fit
    windows: list[Window]  # that are rendered; in novel views if there are any
    analytic: float  # mean PSNR (dB) of the windows without networks
    pictures: dict[str, Window]  # one whole photo of each scene, by the scene's name


def make_validation_set(validation: Sequence[Example], options: TrainOptions) -> ValidationSet:
    """Crops, windows and whole photos, which depend only on the seed; a photo is of the first example of its scene."""
    rng = np.random.default_rng([options.seed, VALIDATION])
    every = [example for example in validation for _ in range(options.validation_crops)]
    crops = [sample_crop(example, options.crop, options.inner, rng) for example in every]
    every = [example for example in validation for _ in range(options.validation_windows)]
    windows = [sample_window(example, options.window, options.most, 1, rng) for example in every]
    scores = parallel_map(lambda window: window_psnr(window, None), windows)
    firsts: dict[str, Window] = {}
    for example in validation:
        ids = [*example.photo_ids(novel=True), *example.photo_ids(novel=False), 0]
        if example.name not in firsts:
            firsts[example.name] = whole_photo(example, ids[0])
    return ValidationSet(crops, windows, float(np.mean(scores)), firsts)


def validate(networks: Networks, reference: ValidationSet, scales: Mapping[int, Tensor], options: TrainOptions) -> Row:
    """Validation loss, PSNR of renders, and the explained share of the targets' squares for each kind of correction."""

    def work(crop: Crop) -> tuple[float, Tensor, Tensor]:
        with torch.no_grad():
            corrections, targets = scaled_corrections(crop, networks, scales, options, 0)
            loss = float(correction_loss(corrections, targets, options))
            return loss, (corrections - targets).square().sum(0), targets.square().sum(0)

    losses, left, whole = zip(*parallel_map(work, reference.crops), strict=True)
    missed, squares = torch.stack(left).sum(0), torch.stack(whole).sum(0)
    shares = {
        f"explained_{name}": float(1 - missed[columns].sum() / squares[columns].sum().clamp_min(1e-12))
        for name, columns in PARTS.items()
    }
    learned = float(np.mean(parallel_map(lambda window: window_psnr(window, networks), reference.windows)))
    scores = {"psnr_analytic": reference.analytic, "psnr_learned": learned}
    return {"validation_loss": float(np.mean(losses)), **scores, **shares}


def write_pictures(out: Path, networks: Networks, reference: ValidationSet) -> None:
    """Write ``validation-NAME.png`` for each scene: photo, analytic render and learned render side by side."""

    def draw(item: tuple[str, Window]) -> tuple[str, np.ndarray]:
        name, window = item
        photo = window.part(window.crop.example.photos.images)
        row = torch.cat([photo, render_window(window, None), render_window(window, networks)], 1)
        return name, (row.clamp(0, 1) * 255).round().byte().numpy()

    for name, picture in parallel_map(draw, reference.pictures.items()):
        _, data = cv2.imencode(".png", picture[..., ::-1])
        with atomic_output(out / f"validation-{name}.png", overwrite=True) as temporary:
            temporary.write_bytes(data.tobytes())
