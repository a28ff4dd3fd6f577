"""A scene and its compact versions: bytes, render time, overdraw, quality, and break-even frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gsmerge.errors import UsageError
from gsmerge.measure.evaluate import INPUT, EvaluateOptions, Evaluation, Views, evaluate, near_plane
from gsmerge.measure.speed import Speed, measure_speeds, overdraw
from gsmerge.types import Cameras, Gaussians, Scene


@dataclass(frozen=True)
class Storage:
    """What a file holds."""

    path: str  # the file
    num_gaussians: int  # rows
    bytes: int  # of the file
    by_attribute: Mapping[str, int]  # bytes of the rows by attribute

    @property
    def bytes_each(self) -> float:
        """Bytes per Gaussian, header left out."""
        return sum(self.by_attribute.values()) / max(self.num_gaussians, 1)


@dataclass(frozen=True)
class SceneCosts:
    """What one of the scenes costs."""

    name: str  # as given
    storage: Storage  # of its file
    speeds: tuple[Speed, ...]  # render time at every size and on every device
    overdraw: float  # Gaussians blended per pixel
    merge_seconds: float | None  # time that making it took; None where it is not known


@dataclass(frozen=True)
class Comparison:
    """A scene and its compact versions."""

    before: SceneCosts  # the scene
    after: tuple[SceneCosts, ...]  # its compact versions
    quality: Evaluation  # of all of them


def break_even(merge_seconds: float, before: float, after: float) -> float | None:
    """Frames after which merging has paid for itself in render time (paper, supplement: timing).

    ``before`` and ``after`` are seconds per frame; None where the result does not render faster.
    """
    return merge_seconds / (before - after) if after < before else None


def compare(
    scene: Scene,
    results: Mapping[str, Gaussians],
    storage: Mapping[str, Storage],
    targets: Views | None = None,
    options: EvaluateOptions | None = None,
    *,
    cameras: Mapping[str, Cameras] | None = None,
    long_sides: tuple[int, ...] | None = None,
    merge_seconds: Mapping[str, float] | None = None,
) -> Comparison:
    """Measure a scene and its compact versions.

    ``storage`` has what their files hold, by name, the scene's under "input"; ``merge_seconds`` the time that making
    them took, where it is known. ``long_sides`` are pixels along the longer side to render at, by default the views'
    own, and twice that; ``cameras`` as of :func:`gsmerge.evaluate`. A UsageError if a size is not positive, or as that.
    """
    own = max(scene.cameras.width, scene.cameras.height)
    sides = (own, 2 * own) if long_sides is None else long_sides
    if not sides or min(sides) < 1:
        raise UsageError(f"long_sides: expected sizes of at least 1 pixel, got {sides}")
    quality = evaluate(scene, results, targets, options, cameras=cameras)
    near = near_plane(scene)
    gaussians_of = {INPUT: scene.file_gaussians, **results}
    threads = None if options is None else options.threads
    speeds = measure_speeds(gaussians_of, scene.cameras, sides, near, threads=threads)
    known = merge_seconds or {}
    before, *after = (
        SceneCosts(name, storage[name], speeds[name], overdraw(gaussians, scene.cameras, near), known.get(name))
        for name, gaussians in gaussians_of.items()
    )
    return Comparison(before, tuple(after), quality)
