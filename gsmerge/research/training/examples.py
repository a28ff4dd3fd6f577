"""Examples to learn from: scenes, and how a full fit changes the K Gaussians of every merged Feature Gaussian.

The networks get some of the scene's views, evenly spread; only the fit uses the others and held-out photos. A full fit
of the analytic Gaussians to all photos, without growth, gives a target for each: fitted minus analytic, in the columns
that networks correct. Gaussians that no photo shows have no target. An example keeps the photos, so that renders can be
compared with them.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge import __version__
from gsmerge.budget import share_text
from gsmerge.errors import SceneError
from gsmerge.geometry import quat_to_rotmat
from gsmerge.io import SceneLoad, load_scene, read_held_out
from gsmerge.io.atomic import atomic_output
from gsmerge.measure.evaluate import Views
from gsmerge.moments import Members
from gsmerge.networks.residuals import COLOR, LOGIT, MEAN, RESIDUAL, ROTATION, SIZE, gaussian_sizes
from gsmerge.networks.tokens import compute_group_features
from gsmerge.options import CompactOptions
from gsmerge.render.photos import Photos, scene_pictures
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.scenes import (
    TrainingScene,
    coverage_masks,
    make_training_scene,
    reduced_masks,
    view_subsets,
)
from gsmerge.stages.decode import divide
from gsmerge.stages.encode import encode
from gsmerge.stages.fit.full import Masks, fit_full
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.stage import visible_mask
from gsmerge.stages.match import match
from gsmerge.stages.merge import merge
from gsmerge.stages.segment import segment
from gsmerge.types import SH_C0, Cameras, FeatureGaussians, Gaussians, Matches, PixelScene

Progress = Callable[[int, int], None]
LAYOUT = 2  # version of the cached files
CHILD_COLUMNS = tuple(f.name + "_" for f in fields(Gaussians))  # arrays of a level in the cache, followed by K
FIT_COLUMNS = ("parents_", "targets_", "mask_")


@dataclass(frozen=True, eq=False)
class Level:
    """K Gaussians for each merged Feature Gaussian, and their corrections by the fit."""

    children: Gaussians  # n analytic Gaussians
    parents: Tensor  # [n] int64, the merged Feature Gaussian of each, ascending
    targets: Tensor  # [n,13] corrections by the fit
    mask: Tensor  # [n] whether there is a target


@dataclass(frozen=True, eq=False)
class Example:
    """A scene to learn from."""

    name: str  # of the scene
    sha256: str  # hash of the scene's content and of the settings
    members: Members  # the scene's Gaussians
    cameras: Cameras  # its views
    features: FeatureGaussians  # g analytic Feature Gaussians before merging
    matches: Matches  # the cluster of each
    centres: Tensor  # [r,3] means after merging
    levels: Mapping[int, Level]  # by number of children K
    photos: Photos  # at the size that renders are scaled_corrections at; those of the views come first, then novel ones
    masks: np.ndarray  # [p,h,w] bool: pixels of the photos that the scene covers

    def photo_ids(self, *, novel: bool) -> list[int]:
        """Photos with a mask that is not empty, of the views or of novel ones."""
        span = range(len(self.cameras), len(self.photos)) if novel else range(len(self.cameras))
        return [photo for photo in span if self.masks[photo].any()]


@dataclass(frozen=True, eq=False)
class Teacher:
    """Reference of the fit: all photos at full and half size, and masks of the pixels that count."""

    name: str
    photos: tuple[Photos, Photos]
    masks: Masks


def read_examples(
    path: Path, options: TrainOptions, cache: Path | None = None, progress: Progress | None = None
) -> list[Example]:
    """A scene folder or ``.ply`` with each number of views and at every density, see :func:`make_example`.

    Photos of a folder ``targets`` next to the ``.ply``, with their cameras, are novel views.

    Args:
        path: The scene.
        options: Numbers of views, densities, matching, steps of the fit, seed.
        cache: Folder for the results of the fits, created if it is missing; None: no cache.
        progress: Called with (step, steps) of the fits.

    Raises:
        SceneError: If the scene cannot be read, is not one Gaussian per pixel, has no photos, or cannot be fitted.
    """
    load = load_scene(path)
    scene, ply = load.scene, load.files.ply
    if not isinstance(scene, PixelScene):
        raise SceneError(ply, "expected one Gaussian per pixel to learn from, found an unaligned scene")
    if scene.images is None:
        raise SceneError(ply, "expected photos to learn from, found none", "put them next to it in images/")
    held_out = _read_held_out(load)
    name, examples = scene_name(path), list[Example]()
    subsets = view_subsets(len(scene), options.views)
    total = len(subsets) * len(options.densities)
    for ids in subsets:
        training = make_training_scene(scene, ids, held_out)
        for density in options.densities:

            def report(step: int, steps: int, number: int = len(examples)) -> None:
                if progress:
                    progress(number * steps + step, total * steps)

            examples.append(make_example(training, options, density, name, cache, report))
    return examples


def scene_name(path: Path) -> str:
    """The folder's name, with that of the file if the path is a file."""
    path = path.absolute()
    return f"{path.parent.name}-{path.stem}" if path.is_file() else path.name


def _read_held_out(load: SceneLoad) -> Views | None:
    """Photos and cameras in the folder ``targets`` next to the scene, if there is one."""
    folder = load.files.ply.parent / "targets"
    if not folder.is_dir():
        return None
    read = read_held_out(load, folder)
    return Views(read.cameras, read.images, read.names)


def make_example(
    training: TrainingScene,
    options: TrainOptions,
    density: float,
    name: str,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Example:
    """Segment, encode, match and merge a scene without networks, fit the result, and store what the fit changed.

    Args:
        training: The scene and the photos.
        options: Levels, matching, steps of the fit, size of the photos, seed.
        density: Superpixels per pixel.
        name: Of the scene, for errors.
        cache: Folder for the results of the fits, created if it is missing; None: no cache.
        progress: Called with (step, steps) of the fit.

    Raises:
        SceneError: If the fit does not improve held-out parts of the photos.
    """
    sha256 = _content_hash(training, options, density)
    file = None if cache is None else cache / f"{sha256[:32]}.npz"
    columns = _read_columns(file, options)
    if columns is None:
        columns = _fit_columns(training, options, density, name, progress)
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_output(file, overwrite=True) as temporary:
                np.savez(temporary, **columns)
    masks = columns.pop("masks")
    tensors = {column: torch.from_numpy(values) for column, values in columns.items()}
    levels = {}
    for k in options.levels:
        children = Gaussians(*(tensors.pop(f"{name}{k}") for name in CHILD_COLUMNS))
        levels[k] = Level(children, *(tensors.pop(f"{name}{k}") for name in FIT_COLUMNS))
    clusters, centres = tensors.pop("clusters"), tensors.pop("centres")
    matches, photos = Matches(clusters, len(centres)), training.photos(options.photo_scale)
    return Example(
        name, sha256, training.members, training.scene.cameras, FeatureGaussians(**tensors), matches, centres, levels,
        photos, masks,
    )  # fmt: skip


def _content_hash(training: TrainingScene, options: TrainOptions, density: float) -> str:
    """Hash of everything that the example depends on."""
    settings = {"layout": LAYOUT, "gsmerge": __version__, "density": density, "match": options.match}
    settings |= {"fit_steps": options.fit_steps, "seed": options.seed, "levels": options.levels}
    settings |= {"photo_scale": options.photo_scale}
    state = hashlib.sha256(json.dumps(settings, sort_keys=True).encode("ascii"))
    g, cameras = training.scene.gaussians, training.cameras
    tensors = [getattr(g, f.name) for f in fields(g)] + [cameras.viewmats, cameras.Ks, training.scene.valid]
    for tensor in [*tensors, torch.from_numpy(training.images)]:
        state.update(json.dumps([str(tensor.dtype), *tensor.shape]).encode("ascii"))
        state.update(np.ascontiguousarray(tensor.numpy()).data)
    return state.hexdigest()


def _read_columns(path: Path | None, options: TrainOptions) -> dict[str, Any] | None:
    """Arrays of an example in the cache; None if there is no readable file."""
    if path is None or not path.is_file():
        return None
    expected = {f.name for f in fields(FeatureGaussians)} | {"clusters", "centres", "masks"}
    expected |= {f"{name}{k}" for name in (*CHILD_COLUMNS, *FIT_COLUMNS) for k in options.levels}
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None  # it is written again
    return columns if columns.keys() == expected else None


def _fit_columns(
    training: TrainingScene, options: TrainOptions, density: float, name: str, progress: Progress | None
) -> dict[str, Any]:
    """Arrays of an example, computed from scratch."""
    changes = {
        "superpixels": share_text(density),
        "match": options.match,
        "fit": "none",
        "robust": False,
        "seed": options.seed,
    }
    settings = CompactOptions().with_settings(changes)
    scene, members = training.scene, training.members
    groups = segment(scene_pictures(scene), settings.segment)
    features = encode(scene, members, groups, settings.encode)
    matches = match(features, settings.match)
    merged = merge(features, matches)
    columns: dict[str, Any] = {f.name: getattr(features, f.name).numpy() for f in fields(features)}
    columns |= {"clusters": matches.clusters.numpy(), "centres": merged.means.numpy()}
    frames = compute_group_features(merged, members, scene.cameras).frames
    masks = coverage_masks(training)
    columns["masks"] = reduced_masks(masks, training.photos(options.photo_scale))
    teacher = _teacher(training, masks, name)
    for number, k in enumerate(options.levels):

        def report(step: int, steps: int, *_: float, number: int = number) -> None:
            if progress:
                progress(number * steps + step, len(options.levels) * steps)

        children, parents = divide(merged, members, np.full(len(merged), k))
        fitted, mask = _fit_level(teacher, children, settings.decode.min_opacity, options, report)
        targets = torch.zeros(len(children), RESIDUAL)
        targets[mask] = corrections_between(children[mask], fitted, frames[torch.from_numpy(parents)][mask])
        columns |= {f"{f.name}_{k}": getattr(children, f.name).numpy() for f in fields(children)}
        columns |= {f"parents_{k}": parents, f"targets_{k}": targets.numpy(), f"mask_{k}": mask.numpy()}
    return columns


def _teacher(training: TrainingScene, masks: np.ndarray, name: str) -> Teacher:
    """All photos: the scene's own whole, and of the others the pixels that the scene covers."""
    photos, masks = (training.photos(), training.photos(2)), masks.copy()
    masks[: len(training.scene)] = True
    return Teacher(name, photos, (masks, reduced_masks(masks, photos[1])))


def _fit_level(
    teacher: Teacher,
    start: Gaussians,
    min_opacity: float,
    options: TrainOptions,
    progress: Callable[[int, int, float, float], None],
) -> tuple[Gaussians, Tensor]:
    """Gaussians after a full fit without growth, and a mask ``[n]`` of those that were fitted, which a photo shows."""
    fit, photos = FitOptions(fit_steps=options.fit_steps), teacher.photos
    mask = start.opacities >= min_opacity
    mask[mask.clone()] = visible_mask(start[mask], photos[1], fit.min_contribution)
    fitted, report = fit_full(start[mask], photos, fit, seed=options.seed, progress=progress, masks=teacher.masks)
    if not report.accepted:
        problem = f"expected a scene that the fit makes better ({report.stopped})"
        raise SceneError(teacher.name, problem, "leave it out")
    return fitted, mask


def corrections_between(start: Gaussians, end: Gaussians, frames: Tensor) -> Tensor:
    """``[n,13]`` corrections in frames ``[n,3,3]`` that turn ``start`` into ``end``."""
    back, sizes = frames.transpose(1, 2), gaussian_sizes(start.scales).clamp_min(1e-12)
    residuals = torch.zeros(len(start), RESIDUAL)
    residuals[:, MEAN] = (back @ (end.means - start.means)[:, :, None])[:, :, 0] / sizes[:, None]
    residuals[:, SIZE] = torch.log(end.scales.clamp_min(1e-12) / start.scales.clamp_min(1e-12))
    rotations = quat_to_rotmat(end.quats) @ quat_to_rotmat(start.quats).transpose(1, 2)
    residuals[:, ROTATION] = (back @ _rotation_vectors(rotations)[:, :, None])[:, :, 0]
    ends = [torch.logit(g.opacities.clamp(0.004, 0.999)) for g in (start, end)]  # clamped as in the fit
    residuals[:, LOGIT] = ends[1] - ends[0]
    residuals[:, COLOR] = SH_C0 * (end.sh0 - start.sh0)[:, 0]
    return residuals.nan_to_num()


def _rotation_vectors(rotations: Tensor) -> Tensor:
    """Rotation vectors ``[n,3]`` of rotations ``[n,3,3]`` well below half a turn."""
    skew = rotations - rotations.transpose(1, 2)
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1) / 2
    sine, cosine = axis.norm(dim=1), (rotations.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return axis * (torch.atan2(sine, cosine) / sine.clamp_min(1e-12))[:, None]
