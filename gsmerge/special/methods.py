"""All methods of compacting a scene behind one interface: gsmerge's method, and methods of other packages.

A package adds a method by an entry point of the group ``gsmerge.methods`` that names a :class:`Method`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from gsmerge.errors import UsageError
from gsmerge.plan import Plan
from gsmerge.prepare.prepare_scene import Prepared, prepare
from gsmerge.runtime.plugins import METHODS, load_plugin
from gsmerge.runtime.record import note
from gsmerge.settings.compact import COUNTS, OURS, CompactOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.settings.stages import DecodeOptions, MatchOptions, PrepareOptions, SegmentOptions
from gsmerge.types import Gaussians, Scene

COMMON = ("method", "seed", "threads", "crop", "drop")  # settings that all methods use


@dataclass(frozen=True)
class Method:
    """A method of compacting a scene: gsmerge's method, or another, such as a baseline.

    Args:
        name: The name on the command line.
        run: A function of a prepared scene, a plan and a number of Gaussians. The function returns at most this number
            of canonical Gaussians, unless the method keeps the Gaussians of the input. The function's parts are blocks
            of :func:`gsmerge.runtime.record.stage`, which measures their time. None: gsmerge's own stages.
        needs_photos: The scene must have photos.
        uses: Flat names of the settings that it uses, besides the settings that all methods use.
        check: Raises a UsageError if a program that the method runs is missing.
        prepare: A function of a scene and options that returns the prepared scene for ``run``.
    """

    name: str
    run: Callable[[Prepared, Plan, int], Gaussians] | None
    needs_photos: bool = False
    uses: tuple[str, ...] = COUNTS
    check: Callable[[], object] = lambda: None
    prepare: Callable[[Scene, PrepareOptions], Prepared] = prepare


OWN_METHOD = Method(OURS, None)


def find_method(options: CompactOptions) -> Method:
    """Load the method that the options name; UsageError if a program that the method runs is missing."""
    if options.method == OURS:
        return OWN_METHOD
    method: Method = load_plugin(METHODS, options.method)
    method.check()
    return method


def is_without_views(scene: Scene, options: CompactOptions) -> bool:
    """Return whether a run works without views: the scene has none, and no option asks for a stage that needs views.

    Without views, Gaussians are merged with their neighbours, by positions and colours alone.
    """
    return len(scene) == 0 and not options.replaces_stages


def choose_method(options: CompactOptions, scene: Scene) -> Method:
    """Choose the method for a scene; a note lists the changed settings that the method ignores.

    Raises UsageError if the scene lacks what the method needs, or if a program that the method runs is missing.
    """
    if is_without_views(scene, options):
        kinds = (PrepareOptions, SegmentOptions, MatchOptions, DecodeOptions)  # settings that act on views
        unused = options.changed(name for kind in kinds for name in flat_settings(kind) if name not in COUNTS)
        if unused:
            note(f"these settings have no effect without cameras: {', '.join(unused)}")
        return replace(OWN_METHOD, prepare=partial(prepare, pixels=False))
    if options.method == OURS:
        return OWN_METHOD
    method = find_method(options)
    place = f"method {method.name}"
    if method.needs_photos and not scene.is_shown:
        raise UsageError(f"{place}: expected photos, found none; give --images, or another method")
    unused = options.changed(name for name in options.to_dict() if name not in (*COMMON, *method.uses))
    if unused:
        note(f"{place} does not use {', '.join(unused)}")
    return method
