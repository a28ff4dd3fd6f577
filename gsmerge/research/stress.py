"""Compact a scene under bad conditions: with worse views, poses, photos or rows.

A case defines how a scene is changed, which scenes it applies to, and the property that must hold. A change returns a
new scene. A change that moves the world also moves the held-out views.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import cv2
import numpy as np

from gsmerge.errors import GsmergeError, UsageError
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.frame import Frame, scene_frame
from gsmerge.method.geometry.transforms import move_views
from gsmerge.method.geometry.views import even_views, subset, take_rows
from gsmerge.run import compact
from gsmerge.runtime.record import Progress
from gsmerge.scoring.evaluate import EvaluateOptions, evaluate
from gsmerge.settings.budget import BudgetOptions
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import SH_C0, Gaussians, Scene, Views

Needs = Literal["anything", "pixels", "photos"]
Check = Literal["better", "same", "near", "once", "again"]

UTM = (4.0e5, 5.0e6, 100.0)  # shift in metres, as large as coordinates of maps

PROPERTIES: dict[Check, str] = {  # of the result
    "better": "not more than {worse:g} dB below its own input",
    "same": "as many Gaussians as the unchanged scene within 0.5 %, counting those that no photo shows, and not more "
    "than {same:g} dB below it",
    "near": "not more than {near:g} dB below the unchanged scene",
    "once": "at most 1.05 times the Gaussians of the unchanged scene, and not more than {same:g} dB below it",
    "again": "compacted again to the same count, not more than {same:g} dB below",
}
SEED = 7  # seed of all random choices
MAX_WORSE = 0.1  # dB by which a result may be below its input
# dB that the result of a changed scene may lose compared with the unchanged scene
MAX_SAME = 0.2
MAX_NEAR = 1.0
# largest relative difference of counts for "same", and largest ratio for "once"
SAME_COUNT = 0.005
ONCE_COUNT = 1.05
_QUICK = EvaluateOptions(lpips=(), fog=False)


@dataclass(frozen=True)
class StressScene:
    """A scene, and the views in which its results are scored."""

    scene: Scene
    views: Views | None  # held-out views in the scene's world; None: the scene's own views


def keep_views(setup: StressScene, choose: Callable[[int], Sequence[int]]) -> StressScene:
    """Keep only some views of a scene. ``choose`` takes the number of views, and returns the ids of the kept views."""
    return replace(setup, scene=subset(setup.scene, choose(len(setup.scene))))


def scale_and_shift(setup: StressScene, factor: float, shift: Sequence[float]) -> StressScene:
    """Scale the world by ``factor``, then shift it by ``shift`` times the size that the scene has after scaling."""
    scene = setup.scene
    views = setup.views
    # the scene's present coordinates are taken as coordinates in ``frame``, and are then moved to the world
    frame = Frame(np.array(shift, np.float64) * scene_frame(scene).unit * factor, factor)
    scene = replace(scene, gaussians=frame.leave(scene.gaussians), cameras=frame.leave_cameras(scene.cameras))
    return StressScene(scene, views and replace(views, cameras=frame.leave_cameras(views.cameras)))


def perturb_poses(setup: StressScene, degrees: float) -> StressScene:
    """Rotate every view and its Gaussians about the view's camera centre and a random axis."""
    viewmats = setup.scene.cameras.viewmats.astype(np.float64)
    rng = np.random.default_rng(SEED)
    for viewmat in viewmats:
        axis = rng.normal(size=3)
        viewmat[:3] = cv2.Rodrigues(np.deg2rad(degrees) * axis / np.linalg.norm(axis))[0] @ viewmat[:3]
    return replace(setup, scene=move_views(setup.scene, viewmats))


def change_exposure(setup: StressScene, share: float) -> StressScene:
    """Make the photo and the Gaussians of every second view brighter by ``share``, and those of the others darker."""
    scene = setup.scene
    assert scene.images is not None
    gains = np.array([1 + share if view % 2 else 1 - share for view in range(len(scene))], np.float32)
    row_gains = gains.repeat(scene.pixels_per_view)[:, None, None]
    g = scene.gaussians
    sh0 = ((0.5 + SH_C0 * g.sh0) * row_gains - 0.5) / SH_C0
    gaussians = replace(g, sh0=sh0, shN=g.shN * row_gains)
    images = (scene.images * gains[:, None, None, None]).clip(0, 1)
    return replace(setup, scene=replace(scene, gaussians=gaussians, images=images, large_photos=None))


def break_rows(setup: StressScene) -> StressScene:
    """Remove 1 % of the rows at random, but at least one row.

    Scenes can lack rows, because the reader of files removes rows with NaN.
    """
    count = len(setup.scene.gaussians)
    broken_share = 0.01  # share of the rows that are removed
    broken = np.random.default_rng(SEED).choice(count, max(1, round(broken_share * count)), replace=False)
    return replace(setup, scene=take_rows(setup.scene, np.delete(np.arange(count), broken)))


@dataclass(frozen=True)
class Case:
    """One bad condition to test compaction under."""

    name: str  # name on the command line
    words: str  # description of the change
    check: Check  # name of the property that must hold, see ``PROPERTIES``
    needs: Needs = "anything"  # what a scene needs: one Gaussian per pixel ("pixels"), or also photos ("photos")
    change: Callable[[StressScene], StressScene] | None = None  # returns the changed scene; None: the scene stays


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("unchanged", "the scene as it is", "better"),
        Case("views-half", "half of the views", "better", "pixels",
             partial(keep_views, choose=lambda num: even_views(num, max(1, num // 2)))),
        Case("views-3", "three views", "better", "pixels",
             partial(keep_views, choose=lambda num: even_views(num, min(3, num)))),
        Case("views-1", "one view", "better", "pixels", partial(keep_views, choose=lambda num: even_views(num, 1))),
        Case("order", "views in another order", "same", "pixels",
             partial(keep_views, choose=lambda num: np.random.default_rng(SEED).permutation(num).tolist())),
        Case("twice", "every view twice", "once", "pixels",
             partial(keep_views, choose=lambda num: [*range(num)] * 2)),
        Case("poses-0.2", "poses 0.2 degrees off", "better", "photos", partial(perturb_poses, degrees=0.2)),
        Case("poses-1", "poses 1 degree off", "better", "photos", partial(perturb_poses, degrees=1.0)),
        Case("poses-5", "poses 5 degrees off", "better", "photos", partial(perturb_poses, degrees=5.0)),
        Case("exposure", "exposure +-20 % by turns", "better", "photos", partial(change_exposure, share=0.2)),
        Case("utm", "moved to map coordinates", "same", "anything", partial(scale_and_shift, factor=1.0, shift=UTM)),
        Case("small", "scaled by 1e-4", "same", "anything", partial(scale_and_shift, factor=1e-4, shift=(0, 0, 0))),
        Case("large", "scaled by 1e4", "same", "anything", partial(scale_and_shift, factor=1e4, shift=(0, 0, 0))),
        Case("broken", "1 % of the rows not finite", "near", "anything", break_rows),
        Case("again", "the result compacted once more", "again"),
    )
}  # fmt: skip


@dataclass(frozen=True)
class StressOutcome:
    """Outcome of one case."""

    case: str  # name of the case
    words: str  # how the scene was changed
    wanted: str  # the property that must hold
    held: bool | None  # True if the property holds; None if the case does not apply to the scene
    found: str  # the measured figures, or the reason why the case does not apply
    seconds: float  # wall time


@dataclass(frozen=True)
class _ScoredResult:
    """A compacted scene and its scores."""

    gaussians: Gaussians
    count: int  # number of Gaussians, including those that no photo shows
    before: float  # PSNR (dB) of the input
    after: float  # PSNR (dB) of the result


def stress(
    scene: Scene,
    options: CompactOptions | None = None,
    *,
    targets: Views | None = None,
    cases: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> tuple[StressOutcome, ...]:
    """Compact a scene under bad conditions, all ``CASES`` or the named ones, and check each result.

    Results are scored on the held-out views ``targets`` if there are any. Without ``targets``, results are scored on
    the photos of the input views, or on renders of the input if it has no photos. ``progress`` is called with (case,
    done, total).

    Raises:
        UsageError: If a case is unknown, or the scene has no views.
    """
    names = list(CASES if cases is None else cases)
    unknown = next((name for name in names if name not in CASES), None)
    if unknown is not None:
        raise UsageError(f"cases: expected some of {', '.join(CASES)}, got {unknown!r}")
    if len(scene) == 0:
        raise UsageError("expected a scene with views, got none")
    options = options or CompactOptions()
    report = progress or (lambda *_: None)
    slack = _fit_slack(options)
    limits = {"same": MAX_SAME + slack, "near": MAX_NEAR + slack, "worse": MAX_WORSE}
    setup = StressScene(scene, targets)
    base = _compact_and_score(setup, options)
    out = []
    for i, name in enumerate(names):
        case = CASES[name]
        start = time.perf_counter()
        report(case.words, i, len(names))
        passed, measured = _check_case(case, setup, base, options)
        seconds = time.perf_counter() - start
        expected = PROPERTIES[case.check].format(**limits)
        out.append(StressOutcome(name, words=case.words, wanted=expected, held=passed, found=measured, seconds=seconds))
    report("done", len(names), len(names))
    return tuple(out)


def _check_case(
    case: Case, setup: StressScene, base: _ScoredResult, options: CompactOptions
) -> tuple[bool | None, str]:
    """Check if the property of a case holds.

    Returns True or False, and the measured figures. For a case that does not apply to the scene, returns None and the
    reason.
    """
    if case.needs != "anything" and not setup.scene.has_own_pixels:
        return None, "needs a Gaussian for each pixel"
    if case.needs == "photos" and setup.scene.images is None:
        return None, "needs photos"
    try:
        if case.check == "again":
            return _check_again(setup, base, options)
        changed = setup if case.change is None else case.change(setup)
        result = base if case.name == "unchanged" else _compact_and_score(changed, options)
    except (GsmergeError, ValueError) as error:  # a case that fails must not end the others
        return False, f"ended with: {error}"
    if not 1 <= len(result.gaussians) <= changed.scene.num_gaussians:
        return False, f"{len(result.gaussians)} Gaussians of {changed.scene.num_gaussians}"
    columns = [name for name, column in vars(result.gaussians).items() if not np.isfinite(column).all()]
    if columns:
        return False, f"{', '.join(columns)} are not finite"
    # The result is compared with its own input, or with the result of the unchanged scene
    figures = f"{len(result.gaussians):,} Gaussians, {result.after:.2f} dB"
    if case.check == "better":
        if math.isinf(result.before):
            return True, f"{figures} against renders of the input"
        return result.after >= result.before - MAX_WORSE, f"{figures}; its input {result.before:.2f} dB"
    count_holds = {
        "once": result.count <= ONCE_COUNT * base.count,
        "same": abs(result.count - base.count) <= max(1, SAME_COUNT * base.count),
    }
    max_loss = MAX_NEAR if case.check == "near" else MAX_SAME
    holds = count_holds.get(case.check, True) and result.after >= base.after - max_loss - _fit_slack(options)
    return holds, f"{figures}; unchanged {len(base.gaussians):,}, {base.after:.2f} dB"


def _compact_and_score(setup: StressScene, options: CompactOptions) -> _ScoredResult:
    """Compact a scene, and measure the PSNR of the input and of the result."""
    result = compact(setup.scene, options)
    count = len(result.gaussians) + result.report.choices.get("pruned", 0)
    return _ScoredResult(result.gaussians, count, *_measure_all_views(setup, result.gaussians))


def _measure_all_views(setup: StressScene, gaussians: Gaussians) -> tuple[float, float]:
    """Measure the PSNR (dB) of the input and of a result.

    If there are no photos, renders of the input are the reference, and the PSNR of the input is infinite.
    """
    evaluation = evaluate(setup.scene, {"result": gaussians}, setup.views, replace(_QUICK, context=setup.views is None))
    split = "context" if setup.views is None else "target"
    before, after = (result.mean(split)[1].psnr for result in evaluation.results)
    return (math.inf if before is None else before), (math.nan if after is None else after)


def _fit_slack(options: CompactOptions) -> float:
    """Return how many dB more than usual a result may lose, because of a full fit in its options."""
    fit_slack = 1.0  # dB; rounding may change the PSNR by this after a full fit, because thin structures depend on it
    return fit_slack if options.fit.fit == "full" else 0.0


def _check_again(setup: StressScene, base: _ScoredResult, options: CompactOptions) -> tuple[bool, str]:
    """Compact the result ``base`` a second time to the same number of Gaussians, and check that the quality stays.

    Returns whether the quality stays, and words with the PSNR after and before the second run.
    """
    scene = setup.scene
    unaligned = Scene(base.gaussians, scene.cameras, scene.images, None, scene.names)
    same_count = BudgetOptions(budget=len(base.gaussians))
    settings = replace(options, budget=same_count, decode=replace(options.decode, k=1))
    after = _measure_all_views(setup, compact(unaligned, settings).gaussians)[1]
    return after >= base.after - MAX_SAME - _fit_slack(options), f"{after:.2f} dB; before {base.after:.2f} dB"
