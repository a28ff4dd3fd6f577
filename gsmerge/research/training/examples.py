"""Make training examples: the Feature Gaussians of a scene's superpixels before any network, and the photos.

The networks get some of the scene's views. The photos of all other views, and held-out photos, are novel views. An
example has fixed views, of which a window may get a random choice (:func:`draw_random_views`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, fields, replace
from gsmerge.method.geometry.pooling import Members, feature_to_gaussians
from gsmerge.method.geometry.transforms import lower_median
from gsmerge.method.raster.photos import Photos, blank_photos, scene_pictures
from gsmerge.method.stages.encode import encode
from gsmerge.method.stages.merge import take_features
from gsmerge.method.stages.superpixels import segment
from gsmerge.reading.held_out import read_held_out
from gsmerge.reading.read_scene import load_scene
from gsmerge.research.training.scenes import (
    TrainingScene,
    covered_pixels,
    make_training_scene,
    measure_covered,
    view_subsets,
)
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.settings.budget import share_text
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import SH_C0, Cameras, FeatureGaussians, Gaussians, Pixels


@dataclass(frozen=True)
class ColorMap:
    """A linear change of colours that is applied to a scene and its photos."""

    order: tuple[int, ...] = (0, 1, 2)  # for each channel, the old channel from which it is taken
    gain: float = 1.0  # factor; negative if colours are inverted
    offset: float = 0.0  # added after the gain, sRGB in [0, 1]

    def change(self, colors: np.ndarray) -> np.ndarray:
        """Change colours ``[...,3]``, sRGB in [0, 1]."""
        return colors.take(self.order, -1) * np.float32(self.gain) + np.float32(self.offset)

    def change_sh0(self, sh0: np.ndarray) -> np.ndarray:
        """Change the sh0 ``[...,3]`` of Gaussians like colours."""
        shift = (self.gain / 2 + self.offset - 0.5) / SH_C0
        return sh0.take(self.order, -1) * np.float32(self.gain) + np.float32(shift)


@dataclass(frozen=True, eq=False)
class Example:
    """A scene for training, or some of its views."""

    name: str  # name of the scene
    unit: float  # unit of length of the scene, the median depth of the Feature Gaussians, in canonical units
    members: Members  # the Gaussians of v views
    cameras: Cameras  # cameras of these v views
    features: FeatureGaussians  # g analytic Feature Gaussians before merging
    base: Gaussians  # g Gaussians, one for each Feature Gaussian
    photos: Photos  # p photos without colours: first the photos of the views, then the photos of novel views
    images: np.ndarray  # [p,h,w,3] uint8, colours of the photos, sRGB
    covers: np.ndarray  # [v,p,h,w] uint8: coverage of photos by the Gaussians of each view, see scenes.coverage
    colors: ColorMap = ColorMap()  # change of the photos' colours; ``images`` are unchanged

    def mask(self, photo: int) -> np.ndarray:
        """Return the mask ``[h,w]`` of a photo's pixels that the views cover."""
        return covered_pixels(self.covers[:, photo])


def make_examples(path: Path, options: TrainOptions) -> Iterator[tuple[str, Callable[[], Example]]]:
    """Yield the label of each example of a scene, and a function that makes it; see :func:`make_example`.

    There is an example for each number of views and each density in ``options``. Photos with cameras in a folder
    ``targets`` next to the ``.ply`` are novel views. Raises SceneError if the scene cannot be read, does not have one
    Gaussian per pixel, or has no photos.
    """
    load = load_scene(path)
    scene = load.scene
    ply = load.files.ply
    if not scene.has_own_pixels:
        raise SceneError(ply, "expected one Gaussian per pixel to learn from, found none")
    if scene.images is None:
        raise SceneError(ply, "expected photos to learn from, found none", "put them next to it in images/")
    targets = ply.parent / "targets"
    held_out = read_held_out(load, targets) if targets.is_dir() else None
    for ids in view_subsets(len(scene), options.example_views):
        training = make_training_scene(scene, ids, held_out)
        for density in options.densities:
            make = partial(make_example, training, options, density, example_name(path))
            label = f"{len(ids)}-views-{share_text(density).rstrip('%')}"
            yield label, make


def example_name(path: Path) -> str:
    """Name a scene by its folder, and by its file as well if the path is a file."""
    path = path.absolute()
    return f"{path.parent.name}-{path.stem}" if path.is_file() else path.name


def make_example(training: TrainingScene, options: TrainOptions, density: float, name: str) -> Example:
    """Segment and encode a scene without networks, by ``density`` superpixels per pixel, into the example ``name``."""
    changes = {"superpixels": share_text(density), "segmentation": options.segmentation, "seed": options.seed}
    settings = CompactOptions().with_settings(changes)
    scene = training.scene
    members = training.members
    features = encode(scene, members, segment(scene_pictures(scene), settings.segment))
    level = options.photo_level(scene.cameras.width, scene.cameras.height)
    images = (training.photos(level).images.clip(0, 1) * 255).round().astype(np.uint8)
    focals = np.sqrt(np.abs(scene.cameras.Ks[:, 0, 0] * scene.cameras.Ks[:, 1, 1]))
    # A footprint is the size of a pixel at the Feature Gaussian's depth, so it is the depth over the focal length
    unit = float(lower_median(features.footprints * focals.astype(np.float64)[features.views]))
    return Example(
        name, unit=unit, members=members, cameras=scene.cameras, features=features, base=feature_to_gaussians(features),
        photos=blank_photos(training.cameras, level), images=images, covers=measure_covered(training, level),
    )  # fmt: skip


def select_example_views(example: Example, ids: Sequence[int]) -> Example:
    """Keep the views ``ids`` (ascending) of an example; photos of other views become novel views."""
    num_views = len(example.cameras)
    members = example.members
    if len(ids) == num_views:
        return example
    new_views = np.full(num_views, -1)  # new number of each view; -1 if it is left out
    new_views[list(ids)] = np.arange(len(ids))
    rows = np.flatnonzero(new_views[example.features.views] >= 0)
    part = take_features(example.features, rows)
    member_rows, pixels = Pixels(members.pixels, members.fronts, own=True).select(ids)  # members of the kept views
    new_rows = np.full(len(members.pixels), -1, np.int32)  # new row of each member; -1 if it is left out
    new_rows[member_rows] = np.arange(len(member_rows), dtype=np.int32)
    columns = {f.name: getattr(members, f.name)[member_rows] for f in fields(Members) if f.name != "fronts"}
    order = [*ids, *(photo for photo in range(len(example.photos)) if photo not in set(ids))]
    photos = example.photos
    return replace(
        example,
        members=Members(**columns | {"pixels": pixels.homes, "fronts": pixels.fronts}),
        cameras=example.cameras[list(ids)],
        features=replace(part, views=new_views[part.views], members=new_rows[part.members]),
        base=example.base[rows],
        photos=replace(photos, viewmats=photos.viewmats[order], Ks=photos.Ks[order]),
        images=example.images[order],
        covers=example.covers[np.ix_(ids, order)],
    )


def draw_random_views(example: Example, options: TrainOptions, rng: np.random.Generator) -> Example:
    """Restrict an example to random views, as many as ``options.random_views`` allows (paper supplement C).

    If ``options.random_views`` is not set, the example keeps its views.
    """
    if not options.random_views:
        return example
    num_views = len(example.cameras)
    least, most = (min(count, num_views) for count in options.random_views)
    count = int(rng.integers(least, most + 1))
    return select_example_views(example, sorted(rng.choice(num_views, count, replace=False).tolist()))


def recolor(example: Example, rng: np.random.Generator) -> Example:
    """Change the colours of an example at random: permute channels, reduce the contrast, and perhaps invert them."""
    gain = float(rng.uniform(0.6, 1))
    low = float(rng.uniform(0, 1 - gain))
    inverted = bool(rng.random() < 0.5)
    colors = ColorMap(tuple(rng.permutation(3).tolist()), -gain if inverted else gain, low + gain * inverted)
    changed: dict[str, Any] = {}
    for name in ("members", "features", "base"):
        part = getattr(example, name)
        shN = part.shN.take(colors.order, -1) * np.float32(colors.gain)
        changed[name] = replace(part, sh0=colors.change_sh0(part.sh0), shN=shN)
    return replace(example, **changed, colors=colors)
