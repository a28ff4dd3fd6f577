"""What a run is judged by, always the same: crops, windows and whole photos of the validation scenes."""

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
from gsmerge.research.training.objective import compared, correction_loss
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.photometric import plain_render, window_psnr
from gsmerge.research.training.predict import Crop, random_crop
from gsmerge.research.training.record import Row
from gsmerge.research.training.windows import Window, random_window, whole_photo
from gsmerge.runtime.threads import parallel_map

PARTS = {"mean": MEAN, "size": SIZE, "turn": ROTATION, "logit": slice(LOGIT, LOGIT + 1), "color": COLOR}
VALIDATION = 2**32  # instead of the step, in what validation's random numbers hang on


@dataclass(frozen=True, eq=False)
class Judge:
    """What validation looks at every time.

    Args:
        crops: Compared with what the fit changed.
        windows: Rendered; in novel views where there are any.
        analytic: Mean PSNR (dB) of the windows without networks.
        pictures: One whole photo of each scene, by the scene's name.
    """

    crops: list[Crop]
    windows: list[Window]
    analytic: float
    pictures: dict[str, Window]


def make_judge(validation: Sequence[Example], options: TrainOptions) -> Judge:
    """Crops, windows and whole photos that hang on the seed alone; the photo is of the first example of its scene."""
    rng = np.random.default_rng([options.seed, VALIDATION])
    every = [example for example in validation for _ in range(options.validation_crops)]
    crops = [random_crop(example, options.crop, options.inner, rng) for example in every]
    every = [example for example in validation for _ in range(options.validation_windows)]
    windows = [random_window(example, options.window, options.most, 1, rng) for example in every]
    scores = parallel_map(lambda window: window_psnr(window, None), windows)
    firsts: dict[str, Window] = {}
    for example in validation:
        ids = [*example.photo_ids(novel=True), *example.photo_ids(novel=False), 0]
        if example.name not in firsts:
            firsts[example.name] = whole_photo(example, ids[0])
    return Judge(crops, windows, float(np.mean(scores)), firsts)


def judged_by(networks: Networks, judge: Judge, scales: Mapping[int, Tensor], options: TrainOptions) -> Row:
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


def write_pictures(out: Path, networks: Networks, judge: Judge) -> None:
    """Write ``validation-NAME.png`` for each scene: photo, analytic render and learned render side by side."""

    def drawn(item: tuple[str, Window]) -> tuple[str, np.ndarray]:
        name, window = item
        photo = window.part(window.crop.example.photos.images)
        row = torch.cat([photo, plain_render(window, None), plain_render(window, networks)], 1)
        return name, (row.clamp(0, 1) * 255).round().byte().numpy()

    for name, picture in parallel_map(drawn, judge.pictures.items()):
        _, data = cv2.imencode(".png", picture[..., ::-1])
        with atomic_output(out / f"validation-{name}.png", overwrite=True) as temporary:
            temporary.write_bytes(data.tobytes())
