"""All ways to compact a scene behind one interface: ours, and those of packages.

A package adds one by an entry point of the group ``gsmerge.methods`` that names a :class:`Method`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from gsmerge.errors import UsageError
from gsmerge.facts.prepare import Prepared, prepare, prepare_alone
from gsmerge.fit import Fitted
from gsmerge.pipeline import build
from gsmerge.plan import Plan, stands_alone
from gsmerge.runtime.plugins import METHODS, load_plugin
from gsmerge.runtime.record import note
from gsmerge.settings.compact import OURS, CompactOptions, changed_settings, decided_settings
from gsmerge.settings.setting import names_of
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import Gaussians, Scene

Need = Literal["photos", "pixels"]
COUNTS = names_of(CompactOptions, lambda one: one.counts)  # settings that decide how many


@dataclass(frozen=True)
class Method:
    """A way to compact a scene: our own, or another, such as a baseline.

    Args:
        name: As on the command line.
        run: Prepared scene, plan and a number of Gaussians -> canonical Gaussians, at most that many unless the method
            keeps the input's. It times itself by stages of the record.
        needs: What the scene has to have: ``"photos"``; ``"pixels"``: one Gaussian per pixel.
        uses: Settings that it uses, by flat name, besides those that all methods use.
        check: Raises a UsageError where a program that it runs is missing.
        prepare: Scene and options -> the prepared scene that ``run`` gets.
    """

    name: str
    run: Callable[[Prepared, Plan, int], Gaussians]
    needs: tuple[Need, ...] = ()
    uses: tuple[str, ...] = COUNTS
    check: Callable[[], object] = lambda: None
    prepare: Callable[[Scene, PrepareOptions], Prepared] = prepare

    def build(self, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
        """Build ``count`` canonical Gaussians; None: as many as ``superpixels`` and K give."""
        gaussians = self.run(prepared, plan, plan.limits.default if count is None else count)
        return Fitted(gaussians, prepared.scene.cameras, None)


@dataclass(frozen=True)
class _Superpixels(Method):
    """Our own method, which fits what it builds."""

    def build(self, prepared: Prepared, plan: Plan, count: int | None) -> Fitted:
        """Build and fit ``count`` canonical Gaussians."""
        return build(prepared, plan, count)


SUPERPIXELS = _Superpixels(OURS, lambda *arguments: build(*arguments).gaussians)


def find_method(options: CompactOptions) -> Method:
    """Load the method that the options name. Raises UsageError if a program is missing."""
    if options.method == OURS:
        return SUPERPIXELS
    method: Method = load_plugin(METHODS, options.method)
    method.check()
    return method


def check_method(options: CompactOptions, scene: Scene) -> tuple[Method, list[str]]:
    """Choose the method for a scene by its options, and note changed settings that the method ignores.

    Raises UsageError if the scene lacks what the method needs, or a program is missing.
    """
    if stands_alone(scene, options):
        return replace(SUPERPIXELS, prepare=prepare_alone), _unused_alone(options)
    method = find_method(options)
    if method is SUPERPIXELS:
        return method, []
    place = f"method {method.name}"
    if "photos" in method.needs and not scene.is_shown:
        raise UsageError(f"{place}: expected photos, found none; give --images, or another method")
    if "pixels" in method.needs and not scene.has_own_pixels:
        raise UsageError(f"{place}: expected Gaussians of the views' own, one for each pixel; give another method")
    unused = [name for name in changed_settings(options, lambda one: not one.common) if name not in method.uses]
    return method, [f"{place} does not use {', '.join(unused)}"] if unused else []


def _unused_alone(options: CompactOptions) -> list[str]:
    """Note changed settings that have no effect on a scene without views."""
    unused = decided_settings(options, lambda one: one.acts_on and not one.counts)
    return [f"without cameras these are not used: {', '.join(unused)}"] if unused else []


def choose_method(options: CompactOptions, scene: Scene) -> Method:
    """Choose the method for a scene as :func:`check_method` does, with a note on ignored settings."""
    method, notes = check_method(options, scene)
    for text in notes:
        note(text)
    return method
