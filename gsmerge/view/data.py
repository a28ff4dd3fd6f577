"""What the page of a scene before and after shows: stills, cameras, scores, and Gaussians for the browser."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import cv2
import numpy as np

from gsmerge.geometry import project
from gsmerge.measure.evaluate import INPUT, EvaluateOptions, Progress, Quality, ResultScores, evaluate
from gsmerge.measure.preview import BORDER_COLOR, Picture, borders, to_picture
from gsmerge.runtime.threads import use_threads
from gsmerge.stages.prepare import scene_frame
from gsmerge.stages.superpixels import SegmentOptions, segment
from gsmerge.types import Cameras, Gaussians, Scene, Views
from gsmerge.view.splats import MAX_GAUSSIANS, highest_degree, pack_splats
from gsmerge.views import even_views

MAX_VIEWS = 32  # of more, some at equal intervals: each takes up to 300 kB
WEBP_QUALITY = 90  # stills are within 1 dB of the scores of lossless ones
OUTLINE_SIDE = 1280  # pixels of the longer side of superpixels' outlines, at most
DEPTH_SAMPLE = 50_000  # Gaussians that say how far away the middle of a view lies


@dataclass(frozen=True)
class Side:
    """The scene itself or one of its results."""

    name: str
    num_gaussians: int
    file_bytes: int
    mean: Quality  # over the views that count: the held-out ones where there are any
    splats: bytes | None  # the Gaussians in the page's frame, see :mod:`gsmerge.view.splats`; None: too many for a page
    sh_degree: int  # of the harmonics that the page has
    file_sh_degree: int  # of those in the file


@dataclass(frozen=True)
class PageView:
    """A view that the page can jump to."""

    name: str
    place: int  # among all views, the input views first
    held_out: bool
    camera: Cameras  # one, in the page's frame
    distance: float  # of what it looks at, in units of that frame
    photo: bytes | None  # WebP
    stills: tuple[bytes, ...]  # WebP, one for each side
    scores: tuple[Quality, ...]  # one for each side, over the pixels that the input views have seen
    outlines: bytes | None = None  # borders of the photo's superpixels as PNG; None of held-out views


@dataclass(frozen=True)
class ViewData:
    """What a page shows.

    Args:
        title: Name of the scene.
        sides: The scene itself, then its results.
        views: The worst of the first result first.
        num_views: Views that were measured, which may be more.
        reference: What scores compare with, in words.
        notes: Warnings and limits, one sentence each.
        num_superpixels: Least and most of a photo with outlines; None where there are none.
    """

    title: str
    sides: tuple[Side, ...]
    views: tuple[PageView, ...]
    num_views: int
    reference: str
    notes: tuple[str, ...]
    num_superpixels: tuple[int, int] | None = None

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
    segmentation: SegmentOptions | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> ViewData:
    """Draw and measure a scene and its results in all views.

    Args:
        title: Name of the scene.
        scene: With at least one view.
        results: Gaussians by name, in the scene's world.
        file_bytes: Sizes of the scene's file and of those of the results.
        held_out: Views that were no input.
        cameras: As of :func:`gsmerge.evaluate`; stills and scores are from there, 3D from the scene's own.
        segmentation: How the input photos are cut into superpixels; None: as by default.
        threads: Threads to use; None: all processors.
        progress: As of :func:`gsmerge.evaluate`.
    """
    splits = {"context": (scene.cameras.numpy(), scene.images, scene.names)}
    splits |= {} if held_out is None else {"target": (held_out.cameras.numpy(), held_out.images, held_out.names)}
    stills: dict[tuple[str, str, int], bytes] = {}

    def keep(result: str, split: str, view: int, image: np.ndarray) -> None:
        stills[result, split, view] = encode_still(to_picture(image))

    options = EvaluateOptions((), threads=threads)
    evaluation = evaluate(scene, results, held_out, options, cameras=cameras, progress=progress, on_image=keep)
    frame = scene_frame(scene)
    named = {INPUT: scene.file_gaussians, **{name: some.numpy() for name, some in results.items()}}
    sides = [
        _side(one, frame.enter(named[one.name]), size, "context" if held_out is None else "target")
        for one, size in zip(evaluation.results, file_bytes, strict=True)
    ]
    means = frame.enter(named[evaluation.results[1].name]).means
    views: list[PageView] = []
    for split, (places, photos, names) in splits.items():
        for i, name in enumerate(short_names(names)):
            camera = frame.enter_cameras(places[[i]])
            views.append(PageView(
                name=name,
                place=len(views),
                held_out=split == "target",
                camera=camera,
                distance=middle_depth(means, camera),
                photo=None if photos is None else encode_still(to_picture(photos[i])),
                stills=tuple(stills[one.name, split, i] for one in evaluation.results),
                scores=tuple(one.scores[len(views)].masked for one in evaluation.results),
            ))  # fmt: skip
    with use_threads(threads):
        shown, num_superpixels = with_outlines(_shown(views), scene.images, segmentation or SegmentOptions())
    notes = (*evaluation.notes, *_limits(sides, len(shown), len(views)))
    return ViewData(title, tuple(sides), shown, len(views), evaluation.reference, notes, num_superpixels)


def with_outlines(
    views: Sequence[PageView], photos: np.ndarray | None, options: SegmentOptions
) -> tuple[tuple[PageView, ...], tuple[int, int] | None]:
    """The views with outlines of the superpixels of the input photos ``[v,h,w,3]``, and least and most of a photo."""
    places = [i for i, view in enumerate(views) if not view.held_out]
    if photos is None or not places:
        return tuple(views), None
    groups = segment(photos[[views[i].place for i in places]], options)
    made = list(views)
    for i, labels in zip(places, groups.labels, strict=True):
        made[i] = replace(views[i], outlines=encode_outlines(labels))
    return tuple(made), (min(groups.counts), max(groups.counts))


def short_names(names: Sequence[str]) -> list[str]:
    """Names of photos without folders and endings, where that tells them apart."""
    stems = [PurePosixPath(name.replace("\\", "/")).stem or name for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def encode_still(picture: Picture) -> bytes:
    """A picture as WebP."""
    _, data = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
    return bytes(data.tobytes())


def encode_outlines(labels: np.ndarray) -> bytes:
    """Borders between superpixels ``[h,w]`` as PNG of several times their size: fine lines on nothing."""
    factor = max(1, OUTLINE_SIDE // max(labels.shape))
    lines = borders(labels.repeat(factor, 0).repeat(factor, 1))
    rows = np.pad(np.packbits(lines, axis=1), ((0, 0), (1, 0)))  # a zero begins each: stored as it is
    parts = {
        b"IHDR": struct.pack(">IIBBBBB", lines.shape[1], lines.shape[0], 1, 3, 0, 0, 0),  # one bit, a palette
        b"PLTE": bytes(3) + bytes(BORDER_COLOR),
        b"tRNS": bytes([0, 255]),
        b"IDAT": zlib.compress(rows.tobytes(), 9),
        b"IEND": b"",
    }
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts.items()
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def middle_depth(means: np.ndarray, camera: Cameras) -> float:
    """Median depth of the points ``[n,3]`` that one camera has in its picture; 1 where there is none."""
    points = means[:: max(1, len(means) // DEPTH_SAMPLE)]
    (pixels,), (depths,) = project(points, camera)
    inside = (depths > 0) & ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(1)
    return float(np.median(depths[inside])) if inside.any() else 1.0


def _side(result: ResultScores, gaussians: Gaussians, file_bytes: int, split: str) -> Side:
    splats, degree = pack_splats(gaussians)
    mean = result.mean(split)[1]
    return Side(result.name, result.num_gaussians, file_bytes, mean, splats, degree, highest_degree(gaussians.shN))


def _shown(views: Sequence[PageView]) -> tuple[PageView, ...]:
    """At most ``MAX_VIEWS`` of them and the worst, the worst of the first result first."""

    def quality(view: PageView) -> float:
        score = view.scores[1].psnr
        return np.inf if score is None else score

    ids = set(even_views(len(views), min(len(views), MAX_VIEWS)))
    ids.add(min(range(len(views)), key=lambda i: quality(views[i])))
    return tuple(sorted((views[i] for i in sorted(ids)), key=quality))


def _limits(sides: Sequence[Side], num_shown: int, num_views: int) -> list[str]:
    """What the page leaves out."""
    notes = []
    for side in sides:
        if side.splats is None:
            notes.append(
                f"{side.name}: {side.num_gaussians:,} Gaussians are too many for a page, which takes"
                f" {MAX_GAUSSIANS:,}: stills only"
            )
        elif side.sh_degree < side.file_sh_degree:
            notes.append(f"{side.name}: in 3D with harmonics up to degree {side.sh_degree} of {side.file_sh_degree}")
    if num_shown < num_views:
        notes.append(f"{num_shown} of {num_views} views are shown, the worst among them; means are over all")
    return notes
