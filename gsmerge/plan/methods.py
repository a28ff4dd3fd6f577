"""Methods of other packages, which compact a scene in their own way.

A package adds a method by an entry point of the group ``gsmerge.methods`` that names a :class:`Method`.
"""

from __future__ import annotations

from collections.abc import Callable

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.pipelines.plan import Plan
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.runtime.plugins import METHODS, load_plugin
from gsmerge.runtime.record import note
from gsmerge.settings.compact import COUNTS, CompactOptions
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import Gaussians, Scene

COMMON = ("method", "seed", "threads", "crop", "drop")  # settings that all methods use


@dataclass(frozen=True)
class Method:
    """A method of compacting a scene other than gsmerge's own, such as a baseline.

    Args:
        name: The name on the command line.
        run: A function of a prepared scene, a plan and a number of Gaussians. The function returns at most this number
            of canonical Gaussians, unless the method keeps the Gaussians of the input. The function's parts are blocks
            of :func:`gsmerge.runtime.record.stage`, which measures their time.
        needs_photos: The scene must have photos.
        uses: Flat names of the settings that it uses, besides the settings that all methods use.
        check: Raises a UsageError if a program that the method runs is missing.
        prepare: A function of a scene and options that returns the prepared scene for ``run``.
    """

    name: str
    run: Callable[[Prepared, Plan, int], Gaussians]
    needs_photos: bool = False
    uses: tuple[str, ...] = COUNTS
    check: Callable[[], object] = lambda: None
    prepare: Callable[[Scene, PrepareOptions], Prepared] = prepare


def find_method(name: str) -> Method:
    """Load the method of this name; UsageError if a program that the method runs is missing."""
    method: Method = load_plugin(METHODS, name)
    method.check()
    return method


def choose_method(options: CompactOptions, scene: Scene) -> Method:
    """Load the method that the options name; a note lists the changed settings that the method ignores.

    Raises UsageError if the scene lacks what the method needs, or if a program that the method runs is missing.
    """
    method = find_method(options.method)
    place = f"method {method.name}"
    if method.needs_photos and not scene.is_shown:
        raise UsageError(f"{place}: expected photos, found none; give --images, or another method")
    unused = options.changed(name for name in options.to_dict() if name not in (*COMMON, *method.uses))
    if unused:
        note(f"{place} does not use {', '.join(unused)}")
    return method
