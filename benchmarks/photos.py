"""Measure results from changed photos: with bands, masks, bars, other tones and other exposures.

python benchmarks/photos.py fern,fox                          # a third of the size, five views
python benchmarks/photos.py fern --cases "half exposure" bgr
python benchmarks/photos.py fern --shrink 2 --cases "gain .5 to 2 in both"
python benchmarks/photos.py eval --cases sound --shrink 1 --views 0   # unchanged photos, to see false alarms
python benchmarks/photos.py train --views 0 --set effort=fast exposure=fixed --cases "auto exposure in all"

Prints the held-out PSNR over all visible pixels, over those inside and outside an ellipse, and over all of them after
the render's colours were aligned with the photo's.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from captures import Targets, make_parser, parse_setting, read_held_out, scene_folders, write_export

import gsmerge
from gsmerge.method.raster.metrics import psnr
from gsmerge.types import Gaussians

BAND = 0.3  # share of a photo's height
METERED, MOST = 0.18, 4.0  # linear light of a photo's middle after an automatic exposure, and its largest gain
# Changes a photo [h,w,3] in [0, 1]. The first argument is the photo's place: 0, 1, 2 ... for context photos, and halves
# for held-out photos between them
Change = Callable[[float, np.ndarray], np.ndarray]


def ellipse_mask(height: int, width: int) -> np.ndarray:
    """Return the mask ``[h,w]`` of an ellipse in the middle of a picture."""
    y, x = (np.arange(height) + 0.5) / height * 2 - 1, (np.arange(width) + 0.5) / width * 2 - 1
    return y[:, None] ** 2 / 0.72 + x**2 / 0.72 < 1


def draw_band(place: float, photo: np.ndarray) -> np.ndarray:
    """Cover the lower part of every second photo with a yellow band."""
    out = photo.copy()
    if place % 2 == 0:
        out[round((1 - BAND) * len(photo)) :] = (0.85, 0.8, 0.1)
    return out


def mask_black(_: float, photo: np.ndarray) -> np.ndarray:
    """Make the pixels outside the ellipse black."""
    return photo * ellipse_mask(*photo.shape[:2])[..., None]


def add_alpha(_: float, photo: np.ndarray) -> np.ndarray:
    """Make the pixels outside the ellipse black and transparent."""
    inside = ellipse_mask(*photo.shape[:2])[..., None]
    return np.concatenate([photo * inside, inside], -1)


def letterbox(_: float, photo: np.ndarray) -> np.ndarray:
    """Squeeze the photo between black bars, in a frame of the same size."""
    height, width = photo.shape[:2]
    bar = round(0.14 * height)
    out = np.zeros_like(photo)
    out[bar : height - bar] = cv2.resize(photo, (width, height - 2 * bar), interpolation=cv2.INTER_AREA)
    return out


def draw_bars(_: float, photo: np.ndarray) -> np.ndarray:
    """Cover the top and the bottom with black bars."""
    out, bar = photo.copy(), round(0.14 * len(photo))
    out[:bar] = out[len(photo) - bar :] = 0
    return out


def pad_bars(_: float, photo: np.ndarray) -> np.ndarray:
    """Add black bars above and below, in a taller frame."""
    bar = round(0.14 * len(photo))
    return np.pad(photo, ((bar, bar), (0, 0), (0, 0)))


def to_linear(_: float, photo: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear light."""
    return np.where(photo <= 0.04045, photo / 12.92, ((photo + 0.055) / 1.055) ** 2.4)


def random_gains(low: float, high: float, channels: int) -> Change:
    """Return a change that multiplies every photo by random factors, one for all ``channels`` or one for each."""

    def change(place: float, photo: np.ndarray) -> np.ndarray:
        random = np.random.default_rng([7, int(place)])
        return np.clip(photo * np.exp(random.uniform(np.log(low), np.log(high), channels)), 0, 1)

    return change


def drift_exposure(place: float, photo: np.ndarray) -> np.ndarray:
    """Multiply by a factor that goes from 1.4 to 0.7 and back along twelve context photos, as in a video."""
    return np.clip(photo * np.exp(0.35 * np.cos(2 * np.pi * place / 12)), 0, 1)


def auto_exposure(share: float) -> Change:
    """Return a change that exposes each photo automatically.

    The light is metered around the middle, with Gaussian weights of a standard deviation of ``share`` of the sides.
    """

    def change(_: float, photo: np.ndarray) -> np.ndarray:
        y, x = (np.linspace(-0.5, 0.5, side) / share for side in photo.shape[:2])
        weights = np.exp(-0.5 * (y[:, None] ** 2 + x**2))[..., None]
        light = to_linear(0, photo)
        gain = np.clip(METERED * 3 * weights.sum() / (weights * light).sum(), 1 / MOST, MOST)
        light = np.clip(gain * light, 0, 1)
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)

    return change


def third_only(change: Change) -> Change:
    """Return a change of the third context photo alone."""
    return lambda place, photo: change(place, photo) if place == 2 else photo


def swap_photos(photos: list[np.ndarray]) -> list[np.ndarray]:
    """Exchange the second and the fourth photo."""
    return [photos[place] for place in (0, 3, 2, 1, *range(4, len(photos)))]


def cover_by_another(photos: list[np.ndarray]) -> list[np.ndarray]:
    """Cover a quarter of the third photo with the middle of the first."""
    height, width = photos[2].shape[:2]
    top, left, covered = height // 4, width // 4, photos[2].copy()
    covered[: height // 2, : width // 2] = photos[0][top : top + height // 2, left : left + width // 2]
    return [*photos[:2], covered, *photos[3:]]


def cover_with_disc(_: float, photo: np.ndarray) -> np.ndarray:
    """Cover a tenth of the photo with a grey disc."""
    height, width = photo.shape[:2]
    y, x = np.mgrid[:height, :width]
    disc = (y - 0.6 * height) ** 2 + (x - 0.4 * width) ** 2 < height * width / (10 * np.pi)
    return np.where(disc[..., None], (0.4, 0.42, 0.45), photo)


def replace_with_noise(place: float, photo: np.ndarray) -> np.ndarray:
    """Replace the photo with noise."""
    return np.random.default_rng([7, int(place)]).random(photo.shape)


def enlarge(_: float, photo: np.ndarray) -> np.ndarray:
    """Enlarge the photo to twice its sides."""
    return cv2.resize(photo, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).clip(0, 1)


def keep(_: float, photo: np.ndarray) -> np.ndarray:
    """Return the photo unchanged."""
    return photo


@dataclass(frozen=True)
class Case:
    """A change of a capture's photos."""

    change: Change  # of each photo
    of_all: Callable[[list[np.ndarray]], list[np.ndarray]] = list  # change of all photos together, which is made first
    gaussians_too: bool = False  # True if the Gaussians are made from the changed photos
    targets_too: bool = False  # True if held-out photos are changed as well
    masks: bool = False  # True if masks of the ellipse lie beside the photos


CASES = {
    "sound": Case(keep),
    "band": Case(draw_band),
    "ellipse": Case(mask_black),
    "alpha": Case(add_alpha),
    "masks": Case(mask_black, masks=True),
    "letterbox": Case(letterbox),
    "bars": Case(draw_bars),
    "padded": Case(pad_bars),
    "linear": Case(to_linear),
    "half exposure": Case(lambda _, photo: 0.5 * photo),
    "gamma 1.8": Case(lambda _, photo: photo**1.8),
    "bgr": Case(lambda _, photo: photo[..., ::-1]),
    "bgr of one": Case(third_only(lambda _, photo: photo[..., ::-1])),
    "gamma 1.8 of one": Case(third_only(lambda _, photo: photo**1.8)),
    "cover": Case(cover_with_disc),
    "cover by another": Case(keep, cover_by_another),
    "one black": Case(third_only(lambda _, photo: 0 * photo)),
    "swapped": Case(keep, swap_photos),
    "twice as large": Case(enlarge),
    "one of noise": Case(third_only(replace_with_noise)),
    "gain .5 to 2 in both": Case(random_gains(0.5, 2, 1), gaussians_too=True),
    "gain .8 to 1.25 in both": Case(random_gains(0.8, 1.25, 1), gaussians_too=True),
    "white balance .8 to 1.25 in both": Case(random_gains(0.8, 1.25, 3), gaussians_too=True),
    "drift .7 to 1.4 in all": Case(drift_exposure, gaussians_too=True, targets_too=True),
    "auto exposure in all": Case(auto_exposure(0.5), gaussians_too=True, targets_too=True),
    "spot exposure in all": Case(auto_exposure(0.15), gaussians_too=True, targets_too=True),
    "gain .8 to 1.25 in photos": Case(random_gains(0.8, 1.25, 1)),
}


def shrink_scene(scene: Path, out: Path, by: int, change: Change | None, *, targets_too: bool) -> Path:
    """Write a capture with photos, depths and confidence ``by`` times smaller; return its folder.

    ``change`` is applied to the context photos, and with ``targets_too`` to the held-out ones.
    """
    shutil.rmtree(out, ignore_errors=True)
    document = json.loads((scene / "transforms.json").read_text())
    place = 0.0
    for frame in document["frames"]:
        for name in ("file_path", "depth_path", "confidence_path"):
            if name not in frame:
                continue
            image = cv2.imread(str(scene / frame[name]), cv2.IMREAD_UNCHANGED)
            size = frame["w"] // by, frame["h"] // by
            kind = cv2.INTER_AREA if name == "file_path" else cv2.INTER_NEAREST
            image = cv2.resize(image, size, interpolation=kind) if by > 1 else image
            path = (out / frame[name]).with_suffix(".png")
            if name == "file_path" and change is not None and (targets_too or frame["role"] == "context"):
                changed = change(place, image[..., ::-1].astype(np.float64) / 255)
                image = np.round(changed[..., ::-1] * 255).astype(np.uint8)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), image)
            frame[name] = str(path.relative_to(out))
        place += 0.5  # context and held-out photos take turns
        for key, side in (("fl_x", "w"), ("cx", "w"), ("fl_y", "h"), ("cy", "h")):
            frame[key] *= (frame[side] // by) / frame[side]
        frame["w"], frame["h"] = frame["w"] // by, frame["h"] // by
    (out / "transforms.json").write_text(json.dumps(document))
    return out


def export_case(scene: Path, case: Case, out: Path, by: int, views: int) -> tuple[Path, Targets]:
    """Write the export of a capture with changed photos; return its ``.ply``, and the held-out photos."""
    shutil.rmtree(out, ignore_errors=True)
    change = case.change if case.gaussians_too else None
    small = shrink_scene(scene, out / "small", by, change, targets_too=case.targets_too)
    path = write_export(small, out / "export", max_views=views or None)
    frames = json.loads((out / "export" / "transforms.json").read_text())["frames"]
    photos = [out / "export" / frame["file_path"] for frame in frames]
    images = case.of_all([cv2.imread(str(file))[..., ::-1].astype(np.float64) / 255 for file in photos])
    for number, (file, photo) in enumerate(zip(photos, images, strict=True)):
        if case.masks:
            (out / "export" / "masks").mkdir(exist_ok=True)
            mask = ellipse_mask(*photo.shape[:2]).astype(np.uint8) * 255
            cv2.imwrite(str(out / "export" / "masks" / f"{file.name}.png"), mask)
        if not case.gaussians_too:
            changed = case.change(number, photo)
            order = [2, 1, 0, 3] if changed.shape[-1] == 4 else [2, 1, 0]
            cv2.imwrite(str(file), np.round(changed[..., order] * 255).astype(np.uint8))
    return path, read_held_out(small)


def fit_colors(image: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Apply the affine colour map (3 x 4) that brings a render closest to its photo within the mask."""
    colors = np.concatenate([image[mask], np.ones((int(mask.sum()), 1))], 1, dtype=np.float64)
    affine = np.linalg.lstsq(colors, photo[mask].astype(np.float64), rcond=None)[0]
    return np.asarray((image @ affine[:3] + affine[3]).clip(0, 1), np.float32)


def measure(gaussians: Gaussians, targets: Targets) -> dict[str, float]:
    """Measure the mean PSNR over all visible pixels, inside and outside the ellipse, and with aligned colours."""
    images = gsmerge.render(gaussians, targets.cameras).images.clip(0, 1)
    inside = ellipse_mask(*images.shape[1:3])
    rows = []
    for image, photo, mask in zip(images, targets.images, targets.masks, strict=True):
        aligned = fit_colors(image, photo, mask)
        parts = [psnr(image, photo, some) for some in (mask, mask & inside, mask & ~inside)]
        rows.append([*parts, psnr(aligned, photo, mask)])
    return dict(zip(("all", "inside", "outside", "aligned"), np.mean(rows, 0).tolist(), strict=True))


def print_row(scene: str, name: str, values: dict[str, float], notes: Sequence[str]) -> None:
    """Print a line of figures by name, and a line for each note."""
    figures = "  ".join(f"{key} {value:6.2f}" for key, value in values.items())
    print(f"{scene:10} {name:40} {figures}", *(f"{'':12}{text}" for text in notes), sep="\n", flush=True)


def main() -> None:
    """Print the scores of every case on every capture."""
    parser = make_parser(__doc__)
    parser.add_argument("--cases", nargs="*", choices=list(CASES), default=list(CASES))
    parser.add_argument("--shrink", type=int, default=3, help="factor by which photos are made smaller")
    parser.add_argument("--views", type=int, default=5, help="context views; 0: all")
    parser.add_argument("--set", nargs="*", default=[], type=parse_setting, help="settings, as name=value")
    args = parser.parse_args()
    for scene in scene_folders(args.scenes):
        for name in args.cases:
            folder = args.cache / f"{scene.name}-{name.replace(' ', '-')}"
            path, targets = export_case(scene, CASES[name], folder, args.shrink, args.views)
            try:
                exported = gsmerge.read_scene(path)
            except gsmerge.GsmergeError as error:
                print(f"{scene.name:10} {name:40} {error}", flush=True)
                continue
            if name == args.cases[0] or CASES[name].gaussians_too:
                print_row(scene.name, f"input, {name}", measure(exported.gaussians, targets), ())
            result = gsmerge.compact(exported, **dict(args.set))
            print_row(scene.name, name, measure(result.gaussians, targets), result.report.notes)


if __name__ == "__main__":
    main()
