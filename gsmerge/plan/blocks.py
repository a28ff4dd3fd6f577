"""Decide in how many blocks a large scene is compacted."""

from __future__ import annotations

from gsmerge.errors import UsageError
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.settings.compact import CompactOptions

BLOCK_GAUSSIANS = 8_000_000  # Gaussians of a block's own views, if the number of blocks is automatic
WHOLE_GAUSSIANS = 20_000_000  # Gaussians up to which a scene is compacted in one piece, unless it has many views
# the two limits above as numbers of views, if blocks see little of each other
BLOCK_VIEWS = 42
WHOLE_VIEWS = 168


def choose_blocks(scene: SceneSize, options: CompactOptions) -> int:
    """Return the number of blocks for a scene.

    Raises UsageError if the scene cannot be cut into the number that was asked for.
    """
    shared = [] if scene.has_own_pixels else ["a scene whose views have no Gaussians of their own"]
    problems = [*options.uncut, *shared]
    count = wanted_blocks(options, scene.num_gaussians, scene.num_views)
    if options.blocks.blocks == "auto":
        count = 1 if problems else min(scene.num_views, count)
    if count <= 1:
        return 1
    if problems:
        raise UsageError(f"blocks {count}: expected one piece (--set blocks=none) with {problems[0]}")
    if count > scene.num_views:
        raise UsageError(f"blocks {count}: expected at most one for each of {scene.num_views} views")
    return count


def wanted_blocks(options: CompactOptions, num_gaussians: int, num_views: int = 0) -> int:
    """Return the largest number of blocks that a run may have by its options; 1 for a run in one piece.

    If the views alone decide the number, it is an upper limit. A small ``num_views`` does not change the number.
    """
    blocks = options.blocks.blocks
    if blocks != "auto":
        return 1 if blocks == "none" else int(blocks)
    if options.uncut:
        return 1
    if num_gaussians > WHOLE_GAUSSIANS:
        return -(-num_gaussians // BLOCK_GAUSSIANS)
    return 1 if num_views <= WHOLE_VIEWS else -(-num_views // BLOCK_VIEWS)
