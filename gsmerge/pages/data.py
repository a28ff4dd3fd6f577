"""Collect the content of the page of a scene before and after: stills, cameras, scores, Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from gsmerge.facts.confirm_depths import Agreement, confirm_depths
from gsmerge.facts.views import even_views
from gsmerge.frame import Frame, scene_frame
from gsmerge.geometry import middle_depth
from gsmerge.io.encode_pictures import encode_indexed, encode_picture
from gsmerge.io.photo_files import photo_array
from gsmerge.measure.camera_path import outside_camera
from gsmerge.measure.error_maps import ErrorReference, draw_errors, expected_errors, make_reference
from gsmerge.measure.evaluate import (
    INPUT,
    EvaluateOptions,
    Evaluation,
    OnImage,
    Progress,
    Quality,
    ResultScores,
    evaluate,
)
from gsmerge.measure.lpips import lpips_available
from gsmerge.measure.preview import OUTSIDE, Picture, draw_borders, mean_colors, to_picture
from gsmerge.pages.marks import Marks, draw_marks, find_marks
from gsmerge.pages.splats import MAX_GAUSSIANS, drawn_rows, highest_degree, pack_splats, pack_support
from gsmerge.raster import Splats, make_splats, render
from gsmerge.raster.metrics import is_worse
from gsmerge.raster.photos import NEAR_PLANE, WHOLE
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.stages import SegmentOptions
from gsmerge.stages.superpixels import segment
from gsmerge.types import Cameras, Gaussians, Scene, Views

LPIPS = "alex"  # network of LPIPS, if its weights are installed; it takes 0.05 s per picture, "vgg" 0.8 s
MAX_VIEWS = 32  # of more views, only so many at equal intervals are shown; each takes up to 300 kB
WEBP_QUALITY = 90  # stills of this quality score within 1 dB of lossless stills
OUTLINE_SIDE = 1280  # largest longer side of a picture of superpixels' outlines, pixels
OUTLINE_LEVELS = 5  # levels per channel of an outline's colour; all colours and transparency then fit into a byte
Stills = dict[tuple[str, str, int], bytes]  # WebP, by result, split and view
OUTLINE_SHIFT = 0.35  # outlines move by this share from the superpixel's colour to white, or to black if it is light


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
    covered_share: float | None  # share of the pixels of these views that the input covers
    covered: Quality  # mean over the covered pixels
    seconds: float  # time to draw a view on this machine, with all threads
    dropped: Mapping[str, int]  # number of Gaussians that ``--drop`` would remove, by its words
    seen: Mapping[str, int]  # number of Gaussians shown by "none" or by "one" of the input views; empty: not known
    support: bytes | None  # number of views that show each packed Gaussian, see :func:`pack_support`; None: not known
    new_gain: tuple[float, float] | None = None  # bounds of the expected gain of new views, dB; None: not known


@dataclass(frozen=True)
class PageView:
    """A view that the page can jump to."""

    name: str
    place: int  # among all views, the input views first
    held_out: bool
    camera: Cameras  # one, in the page's frame
    distance: float  # median depth of the scene, in units of that frame
    photo: bytes | None  # WebP
    stills: tuple[bytes, ...]  # WebP, one for each side
    scores: tuple[Quality, ...]  # one for each side, over the pixels that the input views have seen
    outlines: bytes | None = None  # borders of the photo's superpixels as PNG; None for held-out views
    outside: bool = False  # True for the outside view, which has neither a photo nor scores
    drops: tuple[bytes | None, ...] = ()  # PNG, one for each side: Gaussians that ``--drop`` would remove, coloured
    seen: tuple[bytes | None, ...] = ()  # PNG, one for each side: Gaussians that none or one of the input views shows
    maps: tuple[bytes | None, ...] = ()  # WebP, one for each side: see :mod:`gsmerge.measure.error_maps`
    faded: tuple[bytes | None, ...] = ()  # outside view only: stills with faint Gaussians where no view shows them


@dataclass(frozen=True)
class ViewData:
    """Content of a page: scenes, views, scores and notes."""

    title: str  # name of the scene
    sides: tuple[Side, ...]  # the scene itself, then its results
    views: tuple[PageView, ...]  # the worst first, by the scores of the first result, or of the scene without results
    outside: PageView  # the view from outside the capture
    num_views: int  # number of measured views; `views` may have fewer
    reference: str  # words for the pictures against which scores are measured
    notes: tuple[str, ...]  # warnings and limits, one sentence each
    num_superpixels: tuple[int, int] | None = None  # least and largest number in a photo; None without outlines
    lacks_pixels: bool = False  # if True, the scene itself does not cover all pixels of the input views
    agreement: Agreement | None = None  # share of the depth that other views confirm; None: not known

    @property
    def shown(self) -> tuple[PageView, ...]:
        """The views, followed by the outside view."""
        return (*self.views, self.outside)

    @property
    def start(self) -> int:
        """Index of the view with which the page opens: the view with the median score, or the first without scores.

        Held-out views are preferred, as in the figures at the top; among them, views with LPIPS.
        """
        views = list(enumerate(self.views))
        held_out = [(i, view) for i, view in views if view.held_out] or views
        measured = [i for i, view in held_out if view.scores[-1].lpips_alex is not None]
        candidates = measured or [i for i, _ in held_out]
        return candidates[(len(candidates) - 1) // 2] if self.scored else candidates[0]

    @property
    def scored(self) -> bool:
        """Whether views have scores, because there are photos or several scenes to compare."""
        return len(self.sides) > 1 or any(view.photo is not None for view in self.views)

    @property
    def held_out(self) -> bool:
        """Whether the means are over held-out views."""
        return any(view.held_out for view in self.views)


def collect(
    title: str,
    scene: Scene,
    results: Mapping[str, Gaussians],
    file_bytes: Sequence[int],
    held_out: Views | None = None,
    *,
    cameras: Mapping[str, Cameras] | None = None,
    new_gains: Mapping[str, tuple[float, float]] | None = None,
    light: bool = False,
    progress: Progress = lambda *_: None,
) -> ViewData:
    """Draw and score a scene with at least one view, and its results, in all views.

    ``results`` are Gaussians by name in the scene's world, and may be empty. ``file_bytes``: file sizes of the scene
    and of the results. Stills and scores use ``cameras`` (see :func:`gsmerge.evaluate`); 3D uses the scene's cameras.
    ``new_gains``: bounds of the expected gain of new views, dB; left out if a result is worse than the scene.
    ``light``: show the scene itself in stills only.
    """
    stills: Stills = {}
    nets = (LPIPS,) if lpips_available(LPIPS) else ()
    options = EvaluateOptions(nets, None, fog=False)
    evaluation = evaluate(
        scene, results, held_out, options, cameras=cameras, progress=progress, on_image=still_keeper(stills)
    )
    progress("superpixels and the view from outside", 0, 0)
    with use_threads():
        data = page_data(title, scene, results, file_bytes, held_out, evaluation, stills, cameras=cameras, light=light)
    progress("done", 0, 0)
    return _with_gains(data, new_gains or {})


def _with_gains(data: ViewData, gains: Mapping[str, tuple[float, float]]) -> ViewData:
    """Add the expected gains to the results; a result that shows its own photos worse than the scene has none."""
    sides, notes = [], list[str]()
    for side in data.sides:
        gain = gains.get(side.name)
        if gain is not None and not data.held_out and is_worse(data.sides[0].mean.psnr, side.mean.psnr):
            gain = None
            notes.append(
                f"{side.name} shows these photos worse than {data.title} does, so its expected gain of new views is"
                " left out; is it a result of this scene?"
            )
        sides.append(replace(side, new_gain=gain))
    return replace(data, sides=tuple(sides), notes=(*data.notes, *notes))


def still_keeper(stills: Stills) -> OnImage:
    """Make a function for ``on_image`` of :func:`gsmerge.evaluate` that adds the drawings to ``stills``."""

    def add_still(result: str, split: str, view: int, image: np.ndarray) -> None:
        stills[result, split, view] = encode_still(to_picture(image))

    return add_still


def page_data(
    title: str,
    scene: Scene,
    results: Mapping[str, Gaussians],
    file_bytes: Sequence[int],
    held_out: Views | None,
    evaluation: Evaluation,
    stills: Stills,
    *,
    cameras: Mapping[str, Cameras] | None = None,
    light: bool = False,
) -> ViewData:
    """Make the content of a page from an evaluation and its stills; see :func:`collect`."""
    pictures = photo_array(evaluation.pictures)
    frame = scene_frame(scene)
    named = {INPUT: scene.file_gaussians, **{name: gaussians.numpy() for name, gaussians in results.items()}}
    canonical = {name: frame.enter(gaussians) for name, gaussians in named.items()}
    scene_cameras = frame.enter_cameras(scene.cameras.numpy())
    inspected = [name for name in named if name != INPUT or not results]
    photos = pictures if len(pictures) else None
    marks = {name: Marks() for name in named} | {
        name: find_marks(canonical[name], scene_cameras, photos, own=name == INPUT and scene.has_own_pixels)
        for name in inspected
    }
    split = "context" if held_out is None else "target"
    sides = [
        _side(result, size, split, canonical[result.name], marks[result.name], scene, scene_cameras, light=light)
        for result, size in zip(evaluation.results, file_bytes, strict=True)
    ]
    means = canonical[evaluation.results[:2][-1].name].means  # of the first result, or of the scene without results
    views = _page_views(_split_views(scene, pictures, held_out), evaluation, stills, frame, means)
    shown, num_superpixels = with_outlines(_shown(views), pictures)
    moved = {name: frame.enter_cameras(result_cameras.numpy()) for name, result_cameras in (cameras or {}).items()}
    references = {
        name: make_reference(canonical[name], Views(moved.get(name, scene_cameras), pictures, scene.names), scene.masks)
        for name in (inspected if len(pictures) > 1 else ())
    }
    shown = tuple(replace(view, maps=tuple(_map(references.get(name), view) for name in named)) for view in shown)
    splats = {name: make_splats(canonical[name]) for name in inspected}
    *marked, outside = (
        _with_marks(view, splats, marks) for view in (*shown, _outside_view(scene, named, frame, len(views)))
    )
    faded = tuple(_fade(canonical[name], marks[name], outside.camera) for name in named)
    measured_notes = evaluation.notes if results else ()  # they concern results
    notes = (*measured_notes, *_limits(sides, len(shown), len(views)))
    covered_share, _ = evaluation.results[0].mean_covered("context")
    lacks_pixels = covered_share is not None and covered_share < WHOLE
    agreement = confirm_depths(replace(scene, gaussians=frame.enter(scene.gaussians), cameras=scene_cameras))
    return ViewData(
        title, tuple(sides), tuple(marked), replace(outside, faded=faded), len(views), evaluation.reference, notes,
        num_superpixels, lacks_pixels, agreement,
    )  # fmt: skip


def _split_views(
    scene: Scene, pictures: np.ndarray, held_out: Views | None
) -> dict[str, tuple[Cameras, np.ndarray, Sequence[str]]]:
    """Return cameras in the world, photos and names of the views by split."""
    splits: dict[str, tuple[Cameras, np.ndarray, Sequence[str]]] = {
        "context": (scene.cameras.numpy(), pictures, scene.names)
    }
    if held_out is not None:
        splits["target"] = (held_out.cameras.numpy(), held_out.images, held_out.names)
    return splits


def _fade(gaussians: Gaussians, marks: Marks, camera: Cameras) -> bytes | None:
    """Draw canonical Gaussians, faint where no view shows them; None if views show all."""
    faint = marks.fade(gaussians)
    return None if faint is None else encode_still(to_picture(render(faint, camera, near=NEAR_PLANE).images[0]))


def _with_marks(view: PageView, splats: Mapping[str, Splats], marks: Mapping[str, Marks]) -> PageView:
    """Add to a view the pictures of the marked Gaussians of each side."""
    pictures = [
        draw_marks(splats[name], side_marks, view.camera) if name in splats else (None, None)
        for name, side_marks in marks.items()
    ]
    drops, seen = zip(*pictures, strict=True)
    return replace(view, drops=drops, seen=seen)


def _page_views(
    splits: Mapping[str, tuple[Cameras, np.ndarray, Sequence[str]]],
    evaluation: Evaluation,
    stills: Stills,
    frame: Frame,
    means: np.ndarray,
) -> list[PageView]:
    """List the measured views of the splits, see :func:`_split_views`; ``means [n,3]`` are canonical."""
    views: list[PageView] = []
    for split, (cameras, photos, names) in splits.items():
        if split not in evaluation.num_views:  # only held-out views were measured
            continue
        encoded: list[bytes | None] = [encode_still(to_picture(photo)) for photo in photos]
        encoded = encoded or [None] * len(names)
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


def _outside_view(scene: Scene, named: Mapping[str, Gaussians], frame: Frame, place: int) -> PageView:
    """Draw Gaussians in a scene's world from outside its capture."""
    camera, distance = outside_camera(scene.cameras.numpy(), named[INPUT].means)
    renders = (render(gaussians, camera, near=NEAR_PLANE * frame.unit) for gaussians in named.values())
    return PageView(
        name=OUTSIDE,
        place=place,
        held_out=False,
        camera=frame.enter_cameras(camera),
        distance=distance / frame.unit,
        photo=None,
        stills=tuple(encode_still(to_picture(drawing.images[0])) for drawing in renders),
        scores=(),
        outside=True,
    )


def with_outlines(views: Sequence[PageView], photos: np.ndarray) -> tuple[tuple[PageView, ...], tuple[int, int] | None]:
    """Add outlines of superpixels to the input views with photos; also return their least and largest number."""
    ids = [i for i, view in enumerate(views) if view.photo and not view.held_out]
    if not ids:
        return tuple(views), None
    pictures = photos[[views[i].place for i in ids]]
    groups = segment(pictures, SegmentOptions())
    outlined = list(views)
    for i, picture, labels in zip(ids, pictures, groups.labels, strict=True):
        outlined[i] = replace(views[i], outlines=encode_outlines(picture, labels))
    return tuple(outlined), (min(groups.counts), max(groups.counts))


def short_names(names: Sequence[str]) -> list[str]:
    """Remove folders and endings from photo names, if all short names differ."""
    stems = [PurePosixPath(name.replace("\\", "/")).stem or name for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def encode_still(picture: Picture) -> bytes:
    """Encode a picture as WebP."""
    return encode_picture(picture, WEBP_QUALITY)


def encode_outlines(photo: np.ndarray, labels: np.ndarray) -> bytes:
    """Encode the borders of superpixels ``[h,w]`` as an enlarged, transparent PNG.

    A border has the mean colour of its superpixel in ``photo [h,w,3]``, made lighter, or darker if it is light.
    """
    means = mean_colors(photo, labels)
    light = means.mean(1, keepdims=True) > 0.5
    shifted = means + OUTLINE_SHIFT * (np.where(light, 0.0, 1.0) - means)
    red, green, blue = np.round((OUTLINE_LEVELS - 1) * shifted).astype(np.int64).T
    codes = (red * OUTLINE_LEVELS + green) * OUTLINE_LEVELS + blue
    is_used = np.bincount(codes, minlength=OUTLINE_LEVELS**3) > 0
    levels = np.stack(np.unravel_index(np.flatnonzero(is_used), (OUTLINE_LEVELS,) * 3), 1)
    colors, color_ids = (levels * (255 // (OUTLINE_LEVELS - 1))).astype(np.uint8), np.cumsum(is_used, dtype=np.uint8)
    factor = max(1, OUTLINE_SIDE // max(labels.shape))
    drawn = draw_borders(labels, color_ids[codes], factor)  # numbers of colours from 1 on
    return encode_indexed(drawn, np.pad(colors, ((1, 0), (0, 0))))  # index 0 is transparent


def _map(reference: ErrorReference | None, view: PageView) -> bytes | None:
    """Draw the likely error of one side in a view, estimated by other photos; None without other photos."""
    if reference is None:
        return None
    own = None if view.held_out else view.place
    camera = view.camera if own is None else reference.views.cameras[[own]]
    return encode_still(draw_errors(expected_errors(reference, camera, own)))


def _pack(
    gaussians: Gaussians, name: str, scene: Scene, cameras: Cameras, light: bool
) -> tuple[bytes | None, int, int]:
    """Pack one side's Gaussians for the page; also return the SH degrees of the page and of the file.

    Gaussians and ``cameras`` are canonical. In a ``light`` page the Gaussians of the scene itself are left out.
    """
    highest = highest_degree(gaussians.shN)
    if name != INPUT:
        return *pack_splats(gaussians), highest
    if light:
        return None, highest, highest
    homes = None
    if scene.has_own_pixels:
        homes = scene.get_pixels().homes
        homes = homes if scene.filled is None else homes[~scene.filled]
    return *pack_splats(gaussians, cameras, homes), highest


def _side(
    result: ResultScores,
    file_bytes: int,
    split: str,
    gaussians: Gaussians,
    marks: Marks,
    scene: Scene,
    cameras: Cameras,
    *,
    light: bool,
) -> Side:
    """Collect the data of one side of a page: scores, counts of marked Gaussians, and packed canonical Gaussians."""
    packed = _pack(gaussians, result.name, scene, cameras, light)
    support = None if marks.support is None or packed[0] is None else pack_support(marks.support[drawn_rows(gaussians)])
    dropped, seen = ({word: int(mask.sum()) for word, mask in masks.items()} for masks in (marks.drops, marks.seen))
    mean, covered = result.mean(split)[1], result.mean_covered(split)
    return Side(
        result.name, result.num_gaussians, file_bytes, mean, *packed, *covered, result.render_seconds,
        dropped, seen, support,
    )  # fmt: skip


def _shown(views: Sequence[PageView]) -> tuple[PageView, ...]:
    """Choose at most ``MAX_VIEWS`` views and the worst view, sorted by the scores of the first result, worst first."""

    def quality(view: PageView) -> float:
        score = view.scores[:2][-1].psnr
        return np.inf if score is None else score

    ids = set(even_views(len(views), min(len(views), MAX_VIEWS)))
    ids.add(min(range(len(views)), key=lambda i: quality(views[i])))
    return tuple(sorted((views[i] for i in sorted(ids)), key=quality))


def _limits(sides: Sequence[Side], num_shown: int, num_views: int) -> list[str]:
    """List the Gaussians, harmonics and views that the page leaves out."""
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
