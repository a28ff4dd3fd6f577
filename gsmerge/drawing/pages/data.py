"""Collect the content of the page of a scene before and after: stills, cameras, scores, Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

import numpy as np

from gsmerge.drawing.camera_path import outside_camera
from gsmerge.drawing.pages.splats import MAX_GAUSSIANS, highest_degree, pack_splats
from gsmerge.drawing.preview import OUTSIDE_VIEW, BytePicture, lay_on_chequer, to_picture
from gsmerge.frozen import dataclass, replace
from gsmerge.io.formats.rows import ExpectedScores
from gsmerge.io.photo_files import encode_picture, photo_array
from gsmerge.method.facts.agreement import Agreement
from gsmerge.method.geometry.frame import Frame, scene_frame
from gsmerge.method.geometry.transforms import middle_depth
from gsmerge.method.geometry.views import even_views
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import is_worse
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, NEAR_PLANE, WHOLE_SHARE
from gsmerge.prepare.confirm_depths import confirm_depths
from gsmerge.prepare.fill_holes import large_parts
from gsmerge.runtime.record import Progress
from gsmerge.runtime.threads import use_threads
from gsmerge.scoring.evaluate import INPUT, EvaluateOptions, Evaluation, Quality, ResultScores, evaluate
from gsmerge.scoring.lpips import lpips_available
from gsmerge.types import Cameras, Gaussians, Scene, Views

LPIPS = "alex"  # network of LPIPS, if its weights are installed; it takes 0.05 s per picture, "vgg" 0.8 s
MAX_SHOWN_VIEWS = 32  # most views in a page, chosen at equal intervals; each takes up to 300 kB
SplitViews = tuple[Cameras, np.ndarray, Sequence[str]]  # cameras in the world, photos and names of a split
Stills = dict[tuple[str, str, int], bytes]  # WebP, by result, split and view


@dataclass(frozen=True)
class Side:
    """One side of the comparison: the scene itself or a result."""

    name: str
    num_gaussians: int
    file_bytes: int
    mean: Quality  # mean over the held-out views, or over the input views if no view is held out
    splats: bytes | None  # the Gaussians in the page's frame, see :func:`pack_splats`; None: too many for a page
    sh_degree: int  # degree of the harmonics in the page
    file_sh_degree: int  # degree of the harmonics in the file
    covered_share: float | None  # share of the pixels that the input covers, in the views of ``mean``
    covered: Quality  # mean over the covered pixels of these views
    seconds: float  # time to draw a view on this machine, with all threads
    antialiased: bool  # how its file says that it is drawn, see :func:`gsmerge.render`
    new_views: ExpectedScores | None = None  # expected scores of new views; None if they are not known


@dataclass(frozen=True)
class PageView:
    """A view that the page can jump to."""

    name: str
    place: int  # index among all views; the input views come first
    held_out: bool
    camera: Cameras  # one camera, in the page's frame
    distance: float  # median depth of the scene in the view, in units of the page's frame
    photo: bytes | None  # WebP
    stills: tuple[bytes, ...]  # WebP, one for each side
    scores: tuple[Quality, ...]  # one for each side, over the pixels that the input views have seen
    outside: bool = False  # True for the outside view, which has neither a photo nor scores


@dataclass(frozen=True)
class ViewData:
    """Content of a page: scenes, views, scores and notes."""

    title: str  # name of the scene
    sides: tuple[Side, ...]  # the scene itself, then its results
    views: tuple[PageView, ...]  # the worst first, by the scores of the first result or, without results, of the scene
    outside: PageView  # the view from outside the capture
    num_views: int  # number of measured views; `views` may have fewer
    reference: str  # words for the pictures against which scores are measured
    notes: tuple[str, ...]  # warnings and limits, one sentence each
    lacks_pixels: bool = False  # if True, the scene itself does not cover all pixels of the input views
    agreement: Agreement | None = None  # share of the depth that other views confirm; None: not known
    cut_out: bool = False  # if True, the scene shows nothing in large parts of a view
    changes: tuple[str, ...] = ()  # what was done to photos, cameras and Gaussians before merging, a sentence for each

    @property
    def shown(self) -> tuple[PageView, ...]:
        """All views that the page can jump to: the measured views, then the view from outside."""
        return (*self.views, self.outside)

    @property
    def start(self) -> int:
        """Index of the view with which the page opens.

        The page opens with the view of the median score, or with the first view if no view has scores. Only held-out
        views are considered if a page has held-out views. If some of the considered views have LPIPS, only views with
        LPIPS are considered.
        """
        views = list(enumerate(self.views))
        held_out = [(i, view) for i, view in views if view.held_out] or views
        measured = [i for i, view in held_out if view.scores[-1].lpips_alex is not None]
        candidates = measured or [i for i, _ in held_out]
        return candidates[(len(candidates) - 1) // 2] if self.scored else candidates[0]

    @property
    def scored(self) -> bool:
        """Return whether views have scores, because there are photos or several scenes to compare."""
        return len(self.sides) > 1 or any(view.photo is not None for view in self.views)

    @property
    def held_out(self) -> bool:
        """Return whether the means are over held-out views."""
        return any(view.held_out for view in self.views)


def collect_page_data(
    title: str,
    scene: Scene,
    results: Mapping[str, Gaussians],
    file_bytes: Sequence[int],
    held_out: Views | None = None,
    *,
    cameras: Mapping[str, Cameras] | None = None,
    new_views: Mapping[str, ExpectedScores] | None = None,
    changes: Sequence[str] = (),
    light: bool = False,
    progress: Progress = lambda *_: None,
) -> ViewData:
    """Draw and score a scene with at least one view, and its results, in all views.

    ``results`` are Gaussians by name in the scene's world, and may be empty. ``file_bytes`` are the file sizes of the
    scene and of the results. Stills and scores use ``cameras`` (see :func:`gsmerge.evaluate`); 3D uses the scene's
    cameras. ``new_views`` has the scores that new views are expected to have, by result. For a result that is worse
    than the scene, no gain is shown. ``changes`` says what a run did to its input before it merged. If ``light``, the
    scene itself is shown in stills only.
    """
    stills: Stills = {}
    cut_out = set[tuple[str, int]]()  # split and number of the views in large parts of which the scene shows nothing
    last_alpha = np.empty((0, 0))

    def keep_alpha(result: str, split: str, view: int, alpha: np.ndarray) -> None:
        """Keep the alpha ``[h,w]`` of the next still, and see from that of the scene itself whether it is a cut-out."""
        nonlocal last_alpha
        last_alpha = alpha
        if result == INPUT and large_parts(1 - alpha > COVERED_TRANSMITTANCE).any():
            cut_out.add((split, view))

    def add_still(result: str, split: str, view: int, image: np.ndarray) -> None:
        """Keep the render ``[h,w,3]`` of a view of a split as an encoded still, of a cut-out on a chequered ground."""
        if (split, view) in cut_out:
            image = lay_on_chequer(image, 1 - last_alpha)
        stills[result, split, view] = encode_still(to_picture(image))

    options = EvaluateOptions((LPIPS,) if lpips_available(LPIPS) else (), None, fog=False)
    evaluation = evaluate(
        scene, results, held_out, options, cameras=cameras, progress=progress, on_image=add_still, on_alpha=keep_alpha
    )
    progress("the view from outside", 0, 0)
    with use_threads():
        data = _fill_page(
            title, scene, results=results, file_bytes=file_bytes, held_out=held_out, evaluation=evaluation,
            stills=stills, light=light, cut_out=bool(cut_out),
        )  # fmt: skip
    progress("done", 0, 0)
    sides = []
    notes = list[str]()
    for side in data.sides:
        expected = (new_views or {}).get(side.name)
        if expected is not None and not data.held_out and is_worse(data.sides[0].mean.psnr, side.mean.psnr):
            expected = None
            notes.append(
                f"{side.name} shows these photos worse than {data.title} does, so its expected gain of new views is"
                " left out; is it a result of this scene?"
            )
        sides.append(replace(side, new_views=expected))
    return replace(data, sides=tuple(sides), notes=(*data.notes, *notes), changes=tuple(changes))


def _fill_page(
    title: str,
    scene: Scene,
    results: Mapping[str, Gaussians],
    file_bytes: Sequence[int],
    held_out: Views | None,
    evaluation: Evaluation,
    stills: Stills,
    *,
    light: bool,
    cut_out: bool,
) -> ViewData:
    """Collect the content of a page from an evaluation and its stills, without gains; see :func:`collect_page_data`."""
    pictures = photo_array(evaluation.pictures)
    frame = scene_frame(scene)
    named = {INPUT: scene.file_gaussians, **{name: gaussians.numpy() for name, gaussians in results.items()}}
    canonical = {name: frame.enter(gaussians) for name, gaussians in named.items()}
    scene_cameras = frame.enter_cameras(scene.cameras.numpy())
    split = "context" if held_out is None else "target"
    sides = [
        _collect_side(
            result, size, split=split, gaussians=canonical[result.name], scene=scene, cameras=scene_cameras, light=light
        )
        for result, size in zip(evaluation.results, file_bytes, strict=True)
    ]
    means = canonical[next(iter(results), INPUT)].means  # of the first result; without results, of the scene
    splits: dict[str, SplitViews] = {"context": (scene.cameras.numpy(), pictures, scene.names)}
    if held_out is not None:
        splits["target"] = held_out.cameras.numpy(), held_out.images, held_out.names
    views = _list_views(splits, evaluation, stills, frame, means)
    shown = _choose_shown(views)
    camera, distance = outside_camera(scene.cameras.numpy(), named[INPUT].means)
    renders = [
        render(gaussians, camera, antialiased=side.antialiased, near=NEAR_PLANE * frame.unit)
        for gaussians, side in zip(named.values(), sides, strict=True)
    ]
    outside_images = [drawn.images[0] for drawn in renders]
    if cut_out:
        outside_images = [lay_on_chequer(drawn.images[0], 1 - drawn.alphas[0, ..., 0]) for drawn in renders]
    outside = PageView(
        name=OUTSIDE_VIEW,
        place=len(views),
        held_out=False,
        camera=frame.enter_cameras(camera),
        distance=distance / frame.unit,
        photo=None,
        stills=tuple(encode_still(to_picture(picture)) for picture in outside_images),
        scores=(),
        outside=True,
    )
    result_notes = evaluation.notes if results else ()  # notes of an evaluation concern results
    notes = (*result_notes, *_list_limits(sides, len(shown), len(views)))
    covered_share, _ = evaluation.results[0].mean_covered("context")
    lacks_pixels = covered_share is not None and covered_share < WHOLE_SHARE
    agreement = confirm_depths(replace(scene, gaussians=frame.enter(scene.gaussians), cameras=scene_cameras))
    return ViewData(
        title, sides=tuple(sides), views=shown, outside=outside, num_views=len(views), reference=evaluation.reference,
        notes=notes, lacks_pixels=lacks_pixels, agreement=agreement, cut_out=cut_out,
    )  # fmt: skip


def _list_views(
    splits: Mapping[str, SplitViews], evaluation: Evaluation, stills: Stills, frame: Frame, means: np.ndarray
) -> list[PageView]:
    """List the measured views of all splits. A view's ``distance`` is the median depth of ``means [n,3]`` in it."""
    views: list[PageView] = []
    for split, (cameras, photos, names) in splits.items():
        encoded: list[bytes | None] = [encode_still(to_picture(photo)) for photo in photos]
        encoded = encoded or [None] * len(names)  # without photos
        for i, name in enumerate(short_names(names)):
            camera = frame.enter_cameras(cameras[[i]])
            views.append(PageView(
                name=name,
                place=len(views),
                held_out=split == "target",
                camera=camera,
                distance=middle_depth(means, camera),
                photo=encoded[i],
                stills=tuple(stills[result.name, split, i] for result in evaluation.results),
                scores=tuple(result.scores[len(views)].masked for result in evaluation.results),
            ))  # fmt: skip
    return views


def short_names(names: Sequence[str]) -> list[str]:
    """Remove folders and endings from photo names, if all short names differ."""
    stems = [PurePosixPath(name.replace("\\", "/")).stem or name for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def encode_still(picture: BytePicture) -> bytes:
    """Encode a picture as WebP."""
    webp_quality = 90  # stills of this quality score within 1 dB of lossless stills
    return encode_picture(picture, webp_quality)


def _collect_side(
    result: ResultScores,
    file_bytes: int,
    split: str,
    gaussians: Gaussians,
    scene: Scene,
    cameras: Cameras,
    *,
    light: bool,
) -> Side:
    """Collect the data of one side of a page: mean scores over ``split``, and packed Gaussians.

    ``gaussians`` and ``cameras`` are in the canonical frame.
    """
    file_sh_degree = highest_degree(gaussians.shN)
    if result.name != INPUT:
        splats, sh_degree = pack_splats(gaussians)
    elif light:  # the page shows the scene itself in pictures only
        splats = None
        sh_degree = file_sh_degree
    else:
        homes = None
        if scene.has_own_pixels:
            homes = scene.get_pixels().homes
            homes = homes if scene.filled is None else homes[~scene.filled]  # without rows that the file does not have
        splats, sh_degree = pack_splats(gaussians, cameras, homes)
    covered_share, covered = result.mean_covered(split)
    return Side(
        name=result.name,
        num_gaussians=result.num_gaussians,
        file_bytes=file_bytes,
        mean=result.mean(split)[1],
        splats=splats,
        sh_degree=sh_degree,
        file_sh_degree=file_sh_degree,
        covered_share=covered_share,
        covered=covered,
        seconds=result.render_seconds,
        antialiased=result.antialiased,
    )


def _choose_shown(views: Sequence[PageView]) -> tuple[PageView, ...]:
    """Choose ``MAX_SHOWN_VIEWS`` views and the worst view; return these views, the worst first."""

    def quality(view: PageView) -> float:
        """Return a view's PSNR of the first result, or of a scene without results; infinity if there is no PSNR."""
        psnr = view.scores[min(1, len(view.scores) - 1)].psnr
        return np.inf if psnr is None else psnr

    ids = set(even_views(len(views), min(len(views), MAX_SHOWN_VIEWS)))
    ids.add(min(range(len(views)), key=lambda i: quality(views[i])))
    return tuple(sorted((views[i] for i in sorted(ids)), key=quality))


def _list_limits(sides: Sequence[Side], num_shown: int, num_views: int) -> list[str]:
    """Return notes on the Gaussians, harmonics and views that the page leaves out."""
    notes = []
    for side in sides:
        if side.num_gaussians > MAX_GAUSSIANS and side.splats is None:
            notes.append(
                f"{side.name}: {side.num_gaussians:,} Gaussians are too many for a page, which takes"
                f" {MAX_GAUSSIANS:,}: stills only"
            )
        elif side.sh_degree < side.file_sh_degree:
            notes.append(f"{side.name}: in 3D with harmonics up to degree {side.sh_degree} of {side.file_sh_degree}")
    if num_shown < num_views:
        notes.append(f"{num_shown} of {num_views} views are shown, the worst among them; means are over all")
    return notes
