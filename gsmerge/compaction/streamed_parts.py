"""Levels of a result -> parts of a ``lod-meta.json``: its levels, their errors, and the sky that all of them have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmerge.budget import file_size
from gsmerge.compaction.file_size import NEAR, measure_bytes
from gsmerge.compaction.result import CompactResult
from gsmerge.facts.prepare import scene_frame
from gsmerge.io.atomic import AddOutput
from gsmerge.io.formats.streamed import LeafErrors, add_levels, remove_unused_chunks
from gsmerge.measure.evaluate import near_plane
from gsmerge.measure.level_errors import level_errors
from gsmerge.runtime.record import Progress
from gsmerge.settings.compact import CompactOptions
from gsmerge.stages.sky import sky
from gsmerge.types import Gaussians, PicturedScene, Scene


@dataclass(frozen=True, eq=False)
class StreamedParts:
    """What the chunks of a ``lod-meta.json`` hold, and how the errors of its leaves are measured."""

    levels: list[Gaussians]  # the finest first, without the environment
    environment: Gaussians | None  # sky of the finest level, which is too far away for levels of its own
    measure: LeafErrors | None  # None: viewers choose by distance or by counts

    def noted(self, result: CompactResult) -> CompactResult:
        """Return the result with the decisions about its parts in the report."""
        count = 0 if self.environment is None else len(self.environment)
        choices = {**result.report.choices, "streamed": {"errors": self.measure is not None, "environment": count}}
        return replace(result, report=replace(result.report, choices=choices))

    def write(self, add: AddOutput, out: Path, first: Path, comments: Sequence[str]) -> dict[Path, list[Path]]:
        """Write the index, whose file is ``first`` now, and its chunks: the present files of each level by its path."""
        (_, finest), *coarser = add_levels(
            add, out, first, self.levels, comments, environment=self.environment, measure=self.measure
        )
        return {out: [first, *finest], **dict(coarser)}

    def remove_unused(self, out: Path) -> None:
        """Remove the chunks of an index that was replaced."""
        remove_unused_chunks(out)


def split_levels(
    result: CompactResult, scene: Scene, options: CompactOptions, progress: Progress | None
) -> StreamedParts:
    """Split the levels of a result into parts; the photos of its ``scene`` say where the sky is."""
    levels, cameras = [level.gaussians.numpy() for level in (result, *result.coarser)], result.cameras.numpy()
    kept, environment = levels, None
    if scene.images is not None and "sky" not in options.clean.drops:
        masks = [_sky(PicturedScene(level, cameras, scene.images, None, scene.names)) for level in levels]
        left = [level[~mask] for level, mask in zip(levels, masks, strict=True)]
        if masks[0].any() and all(map(len, left)) and _fits(left, levels[0][masks[0]], options):
            kept, environment = left, levels[0][masks[0]]
    near = near_plane(Scene(levels[0], cameras, None, None, scene.names)) if len(cameras) else 1.0
    return StreamedParts(
        kept, environment, level_errors(kept, cameras, near, environment, progress or (lambda *_: None))
    )


def _sky(scene: PicturedScene) -> np.ndarray:
    """Return a mask ``[n]`` of the Gaussians that show the sky of the scene's photos."""
    frame = scene_frame(scene)
    wide = replace(scene.gaussians, means=scene.gaussians.means.astype(np.float64))
    return sky(frame.enter(wide), frame.enter_cameras(scene.cameras), scene.images)


def _fits(levels: list[Gaussians], environment: Gaussians, options: CompactOptions) -> bool:
    """Return whether the files have the number of bytes that a budget asks for; True without such a budget."""
    size = file_size(options.budget)
    return size is None or NEAR * size.num_bytes <= measure_bytes(levels, size.file, environment) <= size.num_bytes
