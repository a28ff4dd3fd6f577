"""The quality of compact scenes: their renders compared with photos, view by view, next to the input's own."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from gsmerge.errors import UsageError
from gsmerge.measure.visibility import context_points, visible_pixels
from gsmerge.render import render
from gsmerge.render.metrics import psnr, ssim
from gsmerge.render.photos import NEAR
from gsmerge.runtime.threads import use_threads
from gsmerge.stages.prepare import scene_frame
from gsmerge.types import Cameras, Gaussians, PixelScene, UnalignedScene, as_array
from gsmerge.views import pick_views

NETS = ("vgg", "alex")
MIN_SEEN_SHARE = 0.1  # of the held-out pixels, seen by input views; less suggests another world frame
INPUT = "input"  # name of the scene itself among the results
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class EvaluateOptions:
    """What is measured.

    Args:
        lpips: Networks of the perceptual distance, of "vgg" and "alex"; none: it is left out, which is much faster.
        lpips_views: At most so many views of each split get it, evenly spread; None: all.
        context: Also measure the input views.
        own: Also measure the input itself.
        threads: Threads to use; None: all processors. The figures do not depend on it.

    Raises:
        ValueError: If a network is unknown or the number of views not positive.
    """

    lpips: tuple[str, ...] = NETS
    lpips_views: int | None = None
    context: bool = True
    own: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        unknown = next((net for net in self.lpips if net not in NETS), None)
        if unknown is not None:
            raise ValueError(f"lpips: expected {' or '.join(NETS)}, got {unknown!r}")
        if self.lpips_views is not None and self.lpips_views < 1:
            raise ValueError(f"lpips_views: expected at least 1, got {self.lpips_views}")


@dataclass(frozen=True)
class Views:
    """Views with their photos.

    Args:
        cameras: v cameras, in the scene's world.
        images: ``[v,h,w,3]`` sRGB in [0, 1].
        names: Of the views.
    """

    cameras: Cameras
    images: np.ndarray
    names: tuple[str, ...]


@dataclass(frozen=True)
class Quality:
    """How close an image is to another one; None where it was not measured."""

    psnr: float | None = None  # dB; inf for equal pictures
    ssim: float | None = None  # at most 1
    lpips_vgg: float | None = None  # at least 0, lower is closer
    lpips_alex: float | None = None  # the same with AlexNet


@dataclass(frozen=True)
class ViewScore:
    """One result in one view."""

    split: str  # "context": an input view; "target": one that was held out
    view: str  # its name
    visible: float  # share of the pixels that the input views have seen
    full: Quality  # over all pixels
    masked: Quality  # over those that the input views have seen (supplement A)


@dataclass(frozen=True)
class ResultScores:
    """One result."""

    name: str  # as given
    num_gaussians: int  # their number
    ratio: float  # of the input's
    render_seconds: float  # mean wall time of one view, all threads
    scores: tuple[ViewScore, ...]  # one for each view

    def mean(self, split: str) -> tuple[Quality, Quality]:
        """Means over the views of a split: over all pixels, and over the visible ones."""
        mine = [score for score in self.scores if score.split == split]
        return _mean([score.full for score in mine]), _mean([score.masked for score in mine])


@dataclass(frozen=True)
class Evaluation:
    """All results on the same views.

    Args:
        results: The scene itself first, as "input", if it was measured.
        reference: "photos"; "renders of the input" where there are none, "photos, and renders of the input in its own
            views" where there are none of those alone.
        num_views: Views by split.
        notes: Warnings, one sentence each.
    """

    results: tuple[ResultScores, ...]
    reference: str
    num_views: dict[str, int]
    notes: tuple[str, ...]


def evaluate(
    scene: PixelScene | UnalignedScene,
    results: Mapping[str, Gaussians],
    targets: Views | None = None,
    options: EvaluateOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Evaluation:
    """Measure compact results, and the scene itself, on its input views and on held-out ones.

    ``results`` are Gaussians by name, in the scene's world; without photos they are compared with renders of the scene.
    ``targets`` are held-out views in that world, see :func:`gsmerge.io.read_held_out`; ``progress`` is called with
    ("evaluate", done, total) after each result.

    Raises:
        UsageError: If the scene has no views, or a result is called "input".
        GsmergeError: If LPIPS is asked for and its weights are not installed.
    """
    options = options or EvaluateOptions()
    if INPUT in results:
        raise UsageError(f"results: expected names other than {INPUT!r}")
    if len(scene) == 0:
        raise UsageError("expected a scene with views, got none")
    own, results = scene.file_gaussians, {name: gaussians.numpy() for name, gaussians in results.items()}
    if targets is not None:
        targets = replace(targets, cameras=targets.cameras.numpy(), images=as_array(targets.images))
    with use_threads(options.threads):
        near = near_plane(scene)
        points = context_points(scene, near)
        splits = _splits(scene, own, targets, options, near)
        visible = {name: visible_pixels(points, views.cameras, near, scene.cameras) for name, views in splits.items()}
        scores = []
        named = {INPUT: own, **results} if options.own else results
        _image(own[:1], scene.cameras, 0, near)  # loads the kernels, so that no result's time contains that
        for i, (name, gaussians) in enumerate(named.items()):
            scores.append(_score_result(name, gaussians, len(own), splits, visible, options, near))
            if progress:
                progress("evaluate", i + 1, len(named))
    counts = {name: len(views.names) for name, views in splits.items()}
    return Evaluation(tuple(scores), _reference(scene, counts), counts, _notes(visible))


def _reference(scene: PixelScene | UnalignedScene, splits: Mapping[str, int]) -> str:
    """What results are compared with, in words."""
    if scene.images is not None or "context" not in splits:
        return "photos"
    return "photos, and renders of the input in its own views" if "target" in splits else "renders of the input"


def near_plane(scene: PixelScene | UnalignedScene) -> float:
    """Near plane where a scene and its results are compared, world units; there must be a valid Gaussian and a view."""
    return NEAR * scene_frame(scene).unit


def _notes(visible: Mapping[str, NDArray[np.bool_]]) -> tuple[str, ...]:
    if "target" not in visible:
        return ("no held-out views were given: input views flatter what was fitted to them",)
    if visible["target"].mean() < MIN_SEEN_SHARE:
        share = f"{100 * visible['target'].mean():.0f} %"
        return (f"the input views have seen {share} of the held-out views: are those of the same world?",)
    return ()


def _splits(
    scene: PixelScene | UnalignedScene, own: Gaussians, targets: Views | None, options: EvaluateOptions, near: float
) -> dict[str, Views]:
    """The views by split, with their photos or the input's renders."""
    target = {} if targets is None else {"target": targets}
    if targets is not None and not options.context:
        return target
    images = scene.images
    if images is None:
        images = np.stack([_image(own, scene.cameras, view, near) for view in range(len(scene))])
    return {"context": Views(scene.cameras, images, scene.names), **target}


def _score_result(
    name: str,
    gaussians: Gaussians,
    num_input: int,
    splits: Mapping[str, Views],
    visible: Mapping[str, NDArray[np.bool_]],
    options: EvaluateOptions,
    near: float,
) -> ResultScores:
    scores: list[ViewScore] = []
    seconds, count = 0.0, 0
    for split, views in splits.items():
        perceptual = pick_views(len(views.names), options.lpips_views or len(views.names))
        for i, view in enumerate(views.names):
            start = time.perf_counter()
            image = _image(gaussians, views.cameras, i, near)
            seconds, count = seconds + time.perf_counter() - start, count + 1
            nets = options.lpips if i in perceptual else ()
            photo, seen = views.images[i], visible[split][i]
            full = _quality(image, photo, None, nets)
            masked = full if seen.all() else _quality(image, photo, seen, nets) if seen.any() else Quality()
            scores.append(ViewScore(split, view, float(seen.mean()), full, masked))
    ratio = len(gaussians) / max(num_input, 1)
    return ResultScores(name, len(gaussians), ratio, seconds / max(count, 1), tuple(scores))


def _image(gaussians: Gaussians, cameras: Cameras, view: int, near: float) -> np.ndarray:
    """``[h,w,3]``: one view, by the one call that renders here, so that equal Gaussians give equal images."""
    return render(gaussians, cameras[[view]], near=near).images[0].clip(0, 1)


def _quality(image: np.ndarray, photo: np.ndarray, mask: NDArray[np.bool_] | None, nets: Sequence[str]) -> Quality:
    similarity: float | None = None
    distances: dict[str, float] = {}
    with suppress(ValueError):  # no window lies inside the image
        similarity = ssim(image, photo, mask)
    if nets:
        from gsmerge.measure.lpips import lpips, min_size  # loads torch

        side = min(image.shape[:2])
        distances = {f"lpips_{net}": lpips(image, photo, net, mask) for net in nets if side >= min_size(net)}
    return Quality(psnr(image, photo, mask), similarity, **distances)


def _mean(scores: Sequence[Quality]) -> Quality:
    columns = {f.name: [v for one in scores if (v := getattr(one, f.name)) is not None] for f in fields(Quality)}
    return Quality(**{name: float(np.mean(values)) if values else None for name, values in columns.items()})
