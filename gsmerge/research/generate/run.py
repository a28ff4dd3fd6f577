"""Many made scenes, in folders; those that are there already are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gsmerge.research.generate.options import GenerateOptions
from gsmerge.research.generate.scene import make_scene
from gsmerge.research.generate.writing import check_replaceable, is_made, scene_key, write_scene
from gsmerge.runtime.threads import parallel_map, use_threads


@dataclass(frozen=True)
class Generated:
    """One scene of a series.

    Args:
        folder: Where it is.
        kept: It was there already.
    """

    folder: Path
    kept: bool


def plan(out: Path, count: int, options: GenerateOptions, *, seed: int = 0, overwrite: bool = False) -> list[Generated]:
    """What :func:`generate` would do; nothing is written.

    Raises:
        ValueError: If ``count`` or ``seed`` is out of range.
        UsageError: If a folder holds something else.
    """
    if count < 1 or seed < 0:
        raise ValueError(f"expected at least 1 scene and a seed from 0, got {count} and {seed}")
    found = []
    for index in range(count):
        folder = out / f"scene_{index:04d}"
        found.append(Generated(folder, is_made(folder, scene_key(seed, index, options))))
        if not found[-1].kept:
            check_replaceable(folder, overwrite=overwrite)
    return found


def generate_scene(
    folder: Path, options: GenerateOptions | None = None, *, seed: int = 0, index: int = 0, overwrite: bool = False
) -> Path:
    """Make scene ``index`` of the series of ``seed`` in a folder, as :func:`generate` does, and return the folder.

    Raises:
        UsageError: If the folder holds something else.
        SceneError: If the folder cannot be written.
    """
    options = options or GenerateOptions()
    key = scene_key(seed, index, options)
    if not is_made(folder, key):
        check_replaceable(folder, overwrite=overwrite)
        write_scene(folder, make_scene(seed, index, options), key)
    return folder


def generate(
    out: Path,
    count: int,
    options: GenerateOptions | None = None,
    *,
    seed: int = 0,
    overwrite: bool = False,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Generated]:
    """Make scenes ``out/scene_0000`` and on, each different, the same bytes for the same arguments.

    Every folder gets ``scene.ply``, ``transforms.json``, ``images/``, held-out views in ``targets/``, and
    ``generated.json`` with what was drawn. A folder that holds the same scene already is kept, so a call that was
    interrupted goes on where it was, and a call with a larger ``count`` adds to what is there.

    Args:
        out: Folder of the scenes; made where it does not exist.
        count: Number of scenes, at least 1.
        options: What the scenes are like.
        seed: Everything random hangs on it and on the scene's number.
        overwrite: Replace made scenes of other options.
        threads: Threads; None: all processors.
        progress: Called with scenes done and scenes in all.

    Returns:
        The scenes in order.

    Raises:
        ValueError: If ``count`` or ``seed`` is out of range.
        UsageError: If a folder holds something else.
        SceneError: If a folder cannot be written.
    """
    options = options or GenerateOptions()
    planned = plan(out, count, options, seed=seed, overwrite=overwrite)
    todo = [i for i, scene in enumerate(planned) if not scene.kept]

    def work(index: int) -> None:
        generate_scene(planned[index].folder, options, seed=seed, index=index, overwrite=overwrite)

    with use_threads(threads) as workers:
        for first in range(0, len(todo), workers):
            parallel_map(work, todo[first : first + workers])
            if progress is not None:
                progress(count - len(todo) + min(first + workers, len(todo)), count)
    return planned
