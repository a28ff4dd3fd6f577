"""Scenes as examples: where the fit takes the K Gaussians of every merged Feature Gaussian.

Some of the scene's views are given, evenly spread; what the others and held-out photos show is known to the teacher
alone. A full fit of the analytic Gaussians to all photos, without growth, gives a target for each: fitted minus
analytic, in the columns that networks correct. Gaussians that no photo shows have no target. The photos stay with the
example, so that renders can be compared with them.
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
from gsmerge.io import SceneLoad, load_scene, read_targets
from gsmerge.io.atomic import atomic_output
from gsmerge.measure.evaluate import Views
from gsmerge.moments import Members
from gsmerge.networks.residuals import COLOR, LOGIT, MEAN, RESIDUAL, ROTATION, SIZE, gaussian_sizes
from gsmerge.networks.tokens import compute_group_features
from gsmerge.options import CompactOptions
from gsmerge.render.photos import Photos, scene_pictures
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.subjects import Subject, covered, make_subject, reduced_masks, view_subsets
from gsmerge.stages.decode import divide
from gsmerge.stages.encode import encode
from gsmerge.stages.fit.full import Masks, fit_full
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.stage import visible_mask
from gsmerge.stages.match import match
from gsmerge.stages.merge import merge
from gsmerge.stages.segment import segment
from gsmerge.types import SH_C0, Cameras, FeatureGaussians, Gaussians, Matches, PixelScene

Told = Callable[[int, int], None]
LAYOUT = 2  # of the cached files
SHAPE = tuple(f.name + "_" for f in fields(Gaussians))  # columns of a level's children, before K
FITTED = ("parents_", "targets_", "mask_")


@dataclass(frozen=True, eq=False)
class Level:
    """K Gaussians for each merged Feature Gaussian, and what the fit did to them.

    Args:
        children: n analytic Gaussians.
        parents: ``[n]`` int64, the merged Feature Gaussian of each, rising.
        targets: ``[n,13]`` what the fit changed.
        mask: ``[n]`` whether there is a target.
    """

    children: Gaussians
    parents: Tensor
    targets: Tensor
    mask: Tensor


@dataclass(frozen=True, eq=False)
class Example:
    """A scene to learn from.

    Args:
        name: For people.
        sha256: Of the scene's content and of what the example was made with.
        members: The scene's Gaussians.
        cameras: Its views.
        features: ``g`` analytic Feature Gaussians before merging.
        matches: A cluster for each.
        centres: ``[r,3]`` means after merging.
        levels: By number of children K.
        photos: At the size that renders are compared at; those of the views come first, then novel ones.
        masks: ``[p,h,w]`` bool: pixels of the photos that the scene has something to show for.
    """

    name: str
    sha256: str
    members: Members
    cameras: Cameras
    features: FeatureGaussians
    matches: Matches
    centres: Tensor
    levels: Mapping[int, Level]
    photos: Photos
    masks: np.ndarray

    def photo_ids(self, *, novel: bool) -> list[int]:
        """Photos with anything to compare, of the views or of others."""
        span = range(len(self.cameras), len(self.photos)) if novel else range(len(self.cameras))
        return [photo for photo in span if self.masks[photo].any()]


@dataclass(frozen=True, eq=False)
class Teacher:
    """What is fitted to: all photos at full and half size, and which of their pixels count."""

    name: str
    photos: tuple[Photos, Photos]
    masks: Masks


def read_examples(
    path: Path, options: TrainOptions, cache: Path | None = None, progress: Told | None = None
) -> list[Example]:
    """A scene folder or ``.ply`` with each number of views and at every density, see :func:`make_example`.

    Photos of a folder ``targets`` beside the ``.ply``, with their cameras, are novel views.

    Args:
        path: The scene.
        options: Numbers of views, densities, matching, steps of the fit, seed.
        cache: Folder for what takes long; made if it is missing. None: nothing is kept.
        progress: Called with (step, steps) of the fits.

    Raises:
        SceneError: If the scene cannot be read, is not one Gaussian per pixel, has no photos, or cannot be fitted.
    """
    load = load_scene(path)
    scene, ply = load.scene, load.files.ply
    if not isinstance(scene, PixelScene):
        raise SceneError(ply, "expected one Gaussian per pixel to learn from, found them in no order")
    if scene.images is None:
        raise SceneError(ply, "expected photos to learn from, found none", "put them beside it in images/")
    held_out = _held_out(load)
    name, found = scene_name(path), list[Example]()
    subsets = view_subsets(len(scene), options.views)
    total = len(subsets) * len(options.densities)
    for ids in subsets:
        subject = make_subject(scene, ids, held_out)
        for density in options.densities:

            def told(step: int, steps: int, number: int = len(found)) -> None:
                if progress:
                    progress(number * steps + step, total * steps)

            found.append(make_example(subject, options, density, name, cache, told))
    return found


def scene_name(path: Path) -> str:
    """The folder's name, and the file's where one is told."""
    path = path.absolute()
    return f"{path.parent.name}-{path.stem}" if path.is_file() else path.name


def _held_out(load: SceneLoad) -> Views | None:
    """Photos and cameras in the folder ``targets`` beside the scene, where there is one."""
    folder = load.files.ply.parent / "targets"
    if not folder.is_dir():
        return None
    read = read_targets(load, folder)
    return Views(read.cameras, read.images, read.names)


def make_example(
    subject: Subject,
    options: TrainOptions,
    density: float,
    name: str,
    cache: Path | None = None,
    progress: Told | None = None,
) -> Example:
    """Segment, encode, match and merge a scene without networks, fit the result, and note what the fit changed.

    Args:
        subject: One Gaussian per pixel, with photos.
        options: Levels, matching, steps of the fit, size of the photos, seed.
        density: Superpixels per pixel.
        name: For people and errors.
        cache: Folder for what takes long; made if it is missing. None: nothing is kept.
        progress: Called with (step, steps) of the fit.

    Raises:
        SceneError: If the fit does not make held-out parts of the photos better.
    """
    sha256 = _content_hash(subject, options, density)
    kept = None if cache is None else cache / f"{sha256[:32]}.npz"
    columns = _read_columns(kept, options)
    if columns is None:
        columns = _worked_out(subject, options, density, name, progress)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with atomic_output(kept, overwrite=True) as temporary:
                np.savez(temporary, **columns)
    masks = columns.pop("masks")
    tensors = {column: torch.from_numpy(values) for column, values in columns.items()}
    levels = {k: Level(Gaussians(*(tensors.pop(f"{n}{k}") for n in SHAPE)), *(tensors.pop(f"{n}{k}") for n in FITTED))
              for k in options.levels}  # fmt: skip
    clusters, centres = tensors.pop("clusters"), tensors.pop("centres")
    matches, photos = Matches(clusters, len(centres)), subject.photos(options.photo_scale)
    return Example(
        name, sha256, subject.members, subject.scene.cameras, FeatureGaussians(**tensors), matches, centres, levels,
        photos, masks,
    )  # fmt: skip


def _content_hash(subject: Subject, options: TrainOptions, density: float) -> str:
    """Of all that the example hangs on."""
    made_with = {"layout": LAYOUT, "gsmerge": __version__, "density": density, "match": options.match}
    made_with |= {"fit_steps": options.fit_steps, "seed": options.seed, "levels": options.levels}
    made_with |= {"photo_scale": options.photo_scale}
    state = hashlib.sha256(json.dumps(made_with, sort_keys=True).encode("ascii"))
    g, cameras = subject.scene.gaussians, subject.cameras
    tensors = [getattr(g, f.name) for f in fields(g)] + [cameras.viewmats, cameras.Ks, subject.scene.valid]
    for tensor in [*tensors, torch.from_numpy(subject.images)]:
        state.update(json.dumps([str(tensor.dtype), *tensor.shape]).encode("ascii"))
        state.update(np.ascontiguousarray(tensor.numpy()).data)
    return state.hexdigest()


def _read_columns(path: Path | None, options: TrainOptions) -> dict[str, Any] | None:
    """Arrays of an example that is kept; None where there is none that can be read."""
    if path is None or not path.is_file():
        return None
    wanted = {f.name for f in fields(FeatureGaussians)} | {"clusters", "centres", "masks"}
    wanted |= {f"{name}{k}" for name in (*SHAPE, *FITTED) for k in options.levels}
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None  # written anew
    return columns if columns.keys() == wanted else None


def _worked_out(
    subject: Subject, options: TrainOptions, density: float, name: str, progress: Told | None
) -> dict[str, Any]:
    """Arrays of an example, from scratch."""
    settings = {"superpixels": share_text(density), "match": options.match, "fit": "none", "robust": False}
    chosen = CompactOptions().with_settings({**settings, "seed": options.seed})
    scene, members = subject.scene, subject.members
    groups = segment(scene_pictures(scene), chosen.segment)
    features = encode(scene, members, groups, chosen.encode)
    matches = match(features, chosen.match)
    merged = merge(features, matches)
    columns: dict[str, Any] = {f.name: getattr(features, f.name).numpy() for f in fields(features)}
    columns |= {"clusters": matches.clusters.numpy(), "centres": merged.means.numpy()}
    frames = compute_group_features(merged, members, scene.cameras).frames
    masks = covered(subject)
    columns["masks"] = reduced_masks(masks, subject.photos(options.photo_scale))
    teacher = _teacher(subject, masks, name)
    for number, k in enumerate(options.levels):

        def told(step: int, steps: int, *_: float, number: int = number) -> None:
            if progress:
                progress(number * steps + step, len(options.levels) * steps)

        children, parents = divide(merged, members, np.full(len(merged), k))
        fitted, mask = _fitted(teacher, children, chosen.decode.min_opacity, options, told)
        targets = torch.zeros(len(children), RESIDUAL)
        targets[mask] = differences(children[mask], fitted, frames[torch.from_numpy(parents)][mask])
        columns |= {f"{f.name}_{k}": getattr(children, f.name).numpy() for f in fields(children)}
        columns |= {f"parents_{k}": parents, f"targets_{k}": targets.numpy(), f"mask_{k}": mask.numpy()}
    return columns


def _teacher(subject: Subject, masks: np.ndarray, name: str) -> Teacher:
    """All photos: the scene's own are whole, of the others the pixels that it has something to show for."""
    photos, masks = (subject.photos(), subject.photos(2)), masks.copy()
    masks[: len(subject.scene)] = True
    return Teacher(name, photos, (masks, reduced_masks(masks, photos[1])))


def _fitted(
    teacher: Teacher,
    start: Gaussians,
    least: float,
    options: TrainOptions,
    progress: Callable[[int, int, float, float], None],
) -> tuple[Gaussians, Tensor]:
    """Gaussians after a full fit without growth, and which of those given they are ``[n]``: what is not seen is not."""
    fit, photos = FitOptions(fit_steps=options.fit_steps), teacher.photos
    mask = start.opacities >= least
    mask[mask.clone()] = visible_mask(start[mask], photos[1], fit.min_contribution)
    fitted, report = fit_full(
        start[mask], photos, fit, seed=options.seed, progress=progress, masks=teacher.masks
    )  # fmt: skip
    if not report.accepted:
        why = f"expected a scene that the fit makes better ({report.stopped})"
        raise SceneError(teacher.name, why, "leave it out")
    return fitted, mask


def differences(start: Gaussians, end: Gaussians, frames: Tensor) -> Tensor:
    """``[n,13]`` corrections in frames ``[n,3,3]`` that make ``end`` of ``start``."""
    back, sizes = frames.transpose(1, 2), gaussian_sizes(start.scales).clamp_min(1e-12)
    found = torch.zeros(len(start), RESIDUAL)
    found[:, MEAN] = (back @ (end.means - start.means)[:, :, None])[:, :, 0] / sizes[:, None]
    found[:, SIZE] = torch.log(end.scales.clamp_min(1e-12) / start.scales.clamp_min(1e-12))
    turn = quat_to_rotmat(end.quats) @ quat_to_rotmat(start.quats).transpose(1, 2)
    found[:, ROTATION] = (back @ _vectors(turn)[:, :, None])[:, :, 0]
    ends = [torch.logit(g.opacities.clamp(0.004, 0.999)) for g in (start, end)]  # as the fit has them
    found[:, LOGIT] = ends[1] - ends[0]
    found[:, COLOR] = SH_C0 * (end.sh0 - start.sh0)[:, 0]
    return found.nan_to_num()


def _vectors(rotations: Tensor) -> Tensor:
    """Rotation vectors ``[n,3]`` of rotations ``[n,3,3]`` well below half a turn."""
    skew = rotations - rotations.transpose(1, 2)
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1) / 2
    sine, cosine = axis.norm(dim=1), (rotations.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return axis * (torch.atan2(sine, cosine) / sine.clamp_min(1e-12))[:, None]
