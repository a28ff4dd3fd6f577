"""Photos as people have them: held-out PSNR after bands, masks, bars, other tones and exposures.

python benchmarks/photos.py fern,fox                          # a third of the size, five views
python benchmarks/photos.py fern --cases "half exposure" bgr
python benchmarks/photos.py fern --shrink 2 --cases "gain .5 to 2 in both"
python benchmarks/photos.py eval --cases sound --shrink 1 --views 0   # what is found where nothing is wrong
python benchmarks/photos.py train --views 0 --set effort=fast exposure=fixed --cases "auto exposure in all"

Visible pixels; inside and outside an ellipse; after the colours of each held-out photo were aligned.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from captures import Targets, make_parser, read_held_out, scene_folders, setting, write_export

import gsmerge
from gsmerge.raster.metrics import psnr
from gsmerge.types import Gaussians

BAND = 0.3  # of the height
METERED, MOST = 0.18, 4.0  # linear light that an automatic exposure makes of a photo's middle; its largest gain
# place (0, 1, 2 ... for context photos, halves for those between), photo [h,w,3] in [0, 1] -> photo as it is written
Change = Callable[[float, np.ndarray], np.ndarray]


def ellipse(height: int, width: int) -> np.ndarray:
    """The pixels of an ellipse in a picture."""
    y, x = (np.arange(height) + 0.5) / height * 2 - 1, (np.arange(width) + 0.5) / width * 2 - 1
    return y[:, None] ** 2 / 0.72 + x**2 / 0.72 < 1


def band(place: float, photo: np.ndarray) -> np.ndarray:
    """A flat band over the lower part of three of five photos."""
    out = photo.copy()
    if place % 2 == 0:
        out[round((1 - BAND) * len(photo)) :] = (0.85, 0.8, 0.1)
    return out


def mask_black(_: float, photo: np.ndarray) -> np.ndarray:
    return photo * ellipse(*photo.shape[:2])[..., None]


def alpha(_: float, photo: np.ndarray) -> np.ndarray:
    inside = ellipse(*photo.shape[:2])[..., None]
    return np.concatenate([photo * inside, inside], -1)


def letterbox(_: float, photo: np.ndarray) -> np.ndarray:
    """The picture, smaller, between black bars in a frame of the same size."""
    height, width = photo.shape[:2]
    bar = round(0.14 * height)
    out = np.zeros_like(photo)
    out[bar : height - bar] = cv2.resize(photo, (width, height - 2 * bar), interpolation=cv2.INTER_AREA)
    return out


def bars(_: float, photo: np.ndarray) -> np.ndarray:
    """Black bars over the picture."""
    height, out = len(photo), photo.copy()
    bar = round(0.14 * height)
    out[:bar] = out[height - bar :] = 0
    return out


def padded(_: float, photo: np.ndarray) -> np.ndarray:
    """Black bars above and below, in a taller frame."""
    bar = round(0.14 * len(photo))
    return np.pad(photo, ((bar, bar), (0, 0), (0, 0)))


def linear(_: float, photo: np.ndarray) -> np.ndarray:
    return np.where(photo <= 0.04045, photo / 12.92, ((photo + 0.055) / 1.055) ** 2.4)


def gains(low: float, high: float, channels: int) -> Change:
    """Factors for every photo, evenly many brighter and darker."""

    def change(place: float, photo: np.ndarray) -> np.ndarray:
        random = np.random.default_rng([7, int(place)])
        return np.clip(photo * np.exp(random.uniform(np.log(low), np.log(high), channels)), 0, 1)

    return change


def drift(place: float, photo: np.ndarray) -> np.ndarray:
    """Factors of 0.7 to 1.4 that come and go along a video of twelve context photos."""
    return np.clip(photo * np.exp(0.35 * np.cos(2 * np.pi * place / 12)), 0, 1)


def meter(share: float) -> Change:
    """Exposure that a camera chooses for each photo: light is metered within ``share`` of the sides from the middle."""

    def change(_: float, photo: np.ndarray) -> np.ndarray:
        y, x = (np.linspace(-0.5, 0.5, side) / share for side in photo.shape[:2])
        weights = np.exp(-0.5 * (y[:, None] ** 2 + x**2))[..., None]
        light = linear(0, photo)
        gain = np.clip(METERED * 3 * weights.sum() / (weights * light).sum(), 1 / MOST, MOST)
        light = np.clip(gain * light, 0, 1)
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)

    return change


def one(change: Change) -> Change:
    """The change in the third photo alone."""
    return lambda place, photo: change(place, photo) if place == 2 else photo


def swap(photos: list[np.ndarray]) -> list[np.ndarray]:
    """The second and the fourth photo in each other's place."""
    return [photos[place] for place in (0, 3, 2, 1, *range(4, len(photos)))]


def cover_by_another(photos: list[np.ndarray]) -> list[np.ndarray]:
    """A quarter of the third photo shows the middle of the first."""
    height, width = photos[2].shape[:2]
    top, left, covered = height // 4, width // 4, photos[2].copy()
    covered[: height // 2, : width // 2] = photos[0][top : top + height // 2, left : left + width // 2]
    return [*photos[:2], covered, *photos[3:]]


def cover(_: float, photo: np.ndarray) -> np.ndarray:
    """A grey disc over a tenth of the photo."""
    height, width = photo.shape[:2]
    y, x = np.mgrid[:height, :width]
    disc = (y - 0.6 * height) ** 2 + (x - 0.4 * width) ** 2 < height * width / (10 * np.pi)
    return np.where(disc[..., None], (0.4, 0.42, 0.45), photo)


def noise(place: float, photo: np.ndarray) -> np.ndarray:
    return np.random.default_rng([7, int(place)]).random(photo.shape)


def twice_as_large(_: float, photo: np.ndarray) -> np.ndarray:
    return cv2.resize(photo, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).clip(0, 1)


def keep(_: float, photo: np.ndarray) -> np.ndarray:
    return photo


@dataclass(frozen=True)
class Case:
    change: Change
    of_all: Callable[[list[np.ndarray]], list[np.ndarray]] = list  # what needs several photos
    gaussians_too: bool = False  # whether the model saw the photos so
    targets_too: bool = False  # whether held-out photos were taken so
    masks: bool = False  # whether masks lie beside the photos


CASES = {
    "sound": Case(keep),
    "band": Case(band),
    "ellipse": Case(mask_black),
    "alpha": Case(alpha),
    "masks": Case(mask_black, masks=True),
    "letterbox": Case(letterbox),
    "bars": Case(bars),
    "padded": Case(padded),
    "linear": Case(linear),
    "half exposure": Case(lambda _, photo: 0.5 * photo),
    "gamma 1.8": Case(lambda _, photo: photo**1.8),
    "bgr": Case(lambda _, photo: photo[..., ::-1]),
    "bgr of one": Case(one(lambda _, photo: photo[..., ::-1])),
    "gamma 1.8 of one": Case(one(lambda _, photo: photo**1.8)),
    "cover": Case(cover),
    "cover by another": Case(keep, cover_by_another),
    "one black": Case(one(lambda _, photo: 0 * photo)),
    "swapped": Case(keep, swap),
    "twice as large": Case(twice_as_large),
    "one of noise": Case(one(noise)),
    "gain .5 to 2 in both": Case(gains(0.5, 2, 1), gaussians_too=True),
    "gain .8 to 1.25 in both": Case(gains(0.8, 1.25, 1), gaussians_too=True),
    "white balance .8 to 1.25 in both": Case(gains(0.8, 1.25, 3), gaussians_too=True),
    "drift .7 to 1.4 in all": Case(drift, gaussians_too=True, targets_too=True),
    "auto exposure in all": Case(meter(0.5), gaussians_too=True, targets_too=True),
    "spot exposure in all": Case(meter(0.15), gaussians_too=True, targets_too=True),
    "gain .8 to 1.25 in photos": Case(gains(0.8, 1.25, 1)),
}


def shrink_scene(scene: Path, out: Path, by: int, change: Change | None, *, targets_too: bool) -> Path:
    """A scene's folder with photos, depths and confidence ``by`` times smaller; its photos changed."""
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
    """The export of a scene whose photos were changed, and its held-out photos."""
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
            mask = ellipse(*photo.shape[:2]).astype(np.uint8) * 255
            cv2.imwrite(str(out / "export" / "masks" / f"{file.name}.png"), mask)
        if not case.gaussians_too:
            changed = case.change(number, photo)
            order = [2, 1, 0, 3] if changed.shape[-1] == 4 else [2, 1, 0]
            cv2.imwrite(str(file), np.round(changed[..., order] * 255).astype(np.uint8))
    return path, read_held_out(small)


def fit_colors(image: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Apply the affine colour map (3 x 4) that brings a render closest to its photo, over the pixels of the mask."""
    colors = np.concatenate([image[mask], np.ones((int(mask.sum()), 1))], 1, dtype=np.float64)
    affine = np.linalg.lstsq(colors, photo[mask].astype(np.float64), rcond=None)[0]
    return np.asarray((image @ affine[:3] + affine[3]).clip(0, 1), np.float32)


def measure(gaussians: Gaussians, targets: Targets) -> dict[str, float]:
    """Mean PSNR over the visible pixels; inside and outside the ellipse; with colours aligned."""
    images = gsmerge.render(gaussians, targets.cameras).images.clip(0, 1)
    inside = ellipse(*images.shape[1:3])
    rows = []
    for image, photo, mask in zip(images, targets.images, targets.masks, strict=True):
        aligned = fit_colors(image, photo, mask)
        parts = [psnr(image, photo, some) for some in (mask, mask & inside, mask & ~inside)]
        rows.append([*parts, psnr(aligned, photo, mask)])
    return dict(zip(("all", "inside", "outside", "aligned"), np.mean(rows, 0).tolist(), strict=True))


def print_row(scene: str, name: str, values: dict[str, float], notes: Sequence[str]) -> None:
    figures = "  ".join(f"{key} {value:6.2f}" for key, value in values.items())
    print(f"{scene:10} {name:40} {figures}", *(f"{'':12}{text}" for text in notes), sep="\n", flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--cases", nargs="*", choices=list(CASES), default=list(CASES))
    parser.add_argument("--shrink", type=int, default=3, help="photos so many times smaller")
    parser.add_argument("--views", type=int, default=5, help="context views; 0: all")
    parser.add_argument("--set", nargs="*", default=[], type=setting, help="settings, as name=value")
    args = parser.parse_args()
    for scene in scene_folders(args.scenes):
        for name in args.cases:
            folder = args.cache / f"{scene.name}-{name.replace(' ', '-')}"
            path, targets = export_case(scene, CASES[name], folder, args.shrink, args.views)
            try:
                given = gsmerge.read_scene(path)
            except gsmerge.GsmergeError as error:
                print(f"{scene.name:10} {name:40} {error}", flush=True)
                continue
            if name == args.cases[0] or CASES[name].gaussians_too:
                print_row(scene.name, f"input, {name}", measure(given.gaussians, targets), ())
            result = gsmerge.compact(given, **dict(args.set))
            print_row(scene.name, name, measure(result.gaussians, targets), result.report.notes)


if __name__ == "__main__":
    main()
