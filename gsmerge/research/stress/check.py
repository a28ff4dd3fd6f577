"""Runs of the stress cases on a scene, and checks of the property of each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmerge.budget import BudgetOptions
from gsmerge.compaction.compact import compact
from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.io.cameras.camera_file import CameraFile, from_viewmats, to_viewmats
from gsmerge.measure.evaluate import EvaluateOptions, evaluate
from gsmerge.research.stress.cases import CASES, PROPERTIES, Case, StressScene
from gsmerge.scene.exporters import AUTO, ReadHints
from gsmerge.scene.read import SceneLoad, align_scene, read_ply_with_hints
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.reading import OpacityChoice
from gsmerge.types import Gaussians, Scene, Views

MAX_WORSE = 0.1  # dB that a result may be below its input
MAX_SAME, MAX_NEAR = 0.2, 1.0  # dB that a changed scene's result may be below the unchanged one's
FIT_SLACK = 1.0  # dB more after a full fit, whose result rounding alone changes this much on thin structures
SAME_COUNT, ONCE_COUNT = 0.005, 1.05  # largest relative difference, and ratio, of counts
_QUICK = EvaluateOptions(lpips=(), fog=False)
_FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class StressOutcome:
    """Outcome of one case."""

    case: str  # its name
    change: str  # how the scene was changed, in words
    expected: str  # the property that must hold
    passed: bool | None  # whether it does; None where the case does not apply to the scene
    measured: str  # the figures, or why the case does not apply
    seconds: float  # wall time

    def to_dict(self) -> dict[str, Any]:
        """Return the outcome under the keys of the report."""
        keys = ("case", "words", "wanted", "held", "found", "seconds")
        return dict(zip(keys, vars(self).values(), strict=True))


@dataclass(frozen=True)
class _Result:
    """A compact result with its figures."""

    gaussians: Gaussians
    before: float
    after: float


def stress(
    load: SceneLoad,
    options: CompactOptions | None = None,
    *,
    targets: Views | None = None,
    cases: Sequence[str] | None = None,
    hints: ReadHints = AUTO,
    progress: Progress | None = None,
) -> tuple[StressOutcome, ...]:
    """Compact a scene under bad conditions: all ``CASES``, or those with some names.

    Results are compared on held-out views (``targets``), or on the input views with their photos, or with renders of
    the input where there are none. ``hints`` are those that the scene was read with; ``progress`` is called with (case,
    done, total).

    Raises:
        UsageError: If a case is unknown, or the scene has no views.
    """
    names = list(CASES if cases is None else cases)
    unknown = next((name for name in names if name not in CASES), None)
    if unknown is not None:
        raise UsageError(f"cases: expected some of {', '.join(CASES)}, got {unknown!r}")
    if len(load.scene) == 0:
        raise UsageError("expected a scene with views, got none")
    options = options or CompactOptions()
    report, slack = progress or (lambda *_: None), _slack(options)
    limits = {"same": MAX_SAME + slack, "near": MAX_NEAR + slack, "worse": MAX_WORSE}
    given = StressScene(load.scene, targets)
    base = _run(given, options) if any(CASES[name].needs not in ("file", "pixel-file") for name in names) else None
    out = []
    for i, name in enumerate(names):
        case, start = CASES[name], time.perf_counter()
        report(case.words, i, len(names))
        passed, measured = _check_case(case, load, given, base, options, hints)
        seconds, expected = time.perf_counter() - start, PROPERTIES[case.check].format(**limits)
        out.append(StressOutcome(name, case.words, expected, passed, measured, seconds))
    report("done", len(names), len(names))
    return tuple(out)


def _check_case(
    case: Case, load: SceneLoad, given: StressScene, base: _Result | None, options: CompactOptions, hints: ReadHints
) -> tuple[bool | None, str]:
    """Check whether the case's property holds, and return that with the figures."""
    problem = _inapplicable(case, load)
    if problem is not None:
        return None, problem
    if case.check == "convention":
        return _check_convention(case, load, hints)
    if case.cameras is not None:
        return _check_cameras(case, load, hints)
    assert base is not None
    try:
        if case.check == "again":
            return _check_again(given, base, options)
        changed = given if case.change is None else case.change(given)
        settings = options if case.threads is None else replace(options, threads=case.threads)
        result = base if case.name == "unchanged" else _run(changed, settings)
    except (GsmergeError, ValueError) as error:  # a case that fails must not end the others
        return False, f"ended with: {error}"
    defect = _find_defect(result.gaussians, changed.scene)
    return (False, defect) if defect else _check_result(case, base, result, _slack(options))


def _inapplicable(case: Case, load: SceneLoad) -> str | None:
    """Say why a case does not apply to a scene; None where it does."""
    scene = load.scene
    if case.needs in ("pixels", "photos", "pixel-file") and not scene.aligned:
        return "needs a Gaussian for each pixel"
    if case.needs == "photos" and scene.images is None:
        return "needs photos"
    if case.needs in ("file", "pixel-file"):
        if load.cameras is None:
            return "needs cameras from a file"
        if case.convention == load.cameras.convention:
            return "is how the cameras' format has them"
    return None


def _run(given: StressScene, options: CompactOptions) -> _Result:
    result = compact(given.scene, options)
    return _Result(result.gaussians, *_quality(given, result.gaussians))


def _quality(given: StressScene, gaussians: Gaussians) -> tuple[float, float]:
    """Measure the PSNR (dB) of the input and of a result on the views; infinite for an input that is the reference."""
    evaluation = evaluate(given.scene, {"result": gaussians}, given.views, replace(_QUICK, context=given.views is None))
    split = "context" if given.views is None else "target"
    before, after = (one.mean(split)[1].psnr for one in evaluation.results)
    return (math.inf if before is None else before), (math.nan if after is None else after)


def _slack(options: CompactOptions) -> float:
    return FIT_SLACK if options.fit.fit == "full" else 0.0


def _check_result(case: Case, base: _Result, result: _Result, slack: float) -> tuple[bool, str]:
    count, former = len(result.gaussians), len(base.gaussians)
    figures = f"{count:,} Gaussians, {result.after:.2f} dB"
    both = f"{figures}; unchanged {former:,}, {base.after:.2f} dB"
    if case.check == "better":
        if math.isinf(result.before):
            return True, f"{figures} against renders of the input"
        return result.after >= result.before - MAX_WORSE, f"{figures}; its input {result.before:.2f} dB"
    if case.check == "bits":
        same = all(np.array_equal(getattr(base.gaussians, n), getattr(result.gaussians, n)) for n in _FIELDS)
        return same, "equal" if same else f"differs: {both}"
    if case.check == "near":
        return result.after >= base.after - MAX_NEAR - slack, both
    near = result.after >= base.after - MAX_SAME - slack
    if case.check == "once":
        return near and count <= ONCE_COUNT * former, both
    return near and abs(count - former) <= max(1, SAME_COUNT * former), both


def _check_again(given: StressScene, base: _Result, options: CompactOptions) -> tuple[bool, str]:
    """Compact the result as a scene of its own to as many Gaussians as it has."""
    scene = given.scene
    unaligned = Scene(base.gaussians, scene.cameras, scene.images, None, scene.names)
    once = replace(options, budget=BudgetOptions(budget=len(base.gaussians)), decode=replace(options.decode, k=1))
    after = _quality(given, compact(unaligned, once).gaussians)[1]
    return after >= base.after - MAX_SAME - _slack(options), f"{after:.2f} dB; before {base.after:.2f} dB"


def _check_convention(case: Case, load: SceneLoad, hints: ReadHints) -> tuple[bool, str]:
    """Read the scene from cameras whose poses are in another convention than that of their format."""
    assert load.cameras is not None
    assert case.convention is not None
    stored = from_viewmats(load.cameras.viewmats, case.convention)
    wrong = replace(load.cameras, viewmats=to_viewmats(stored, load.cameras.convention))
    try:
        read = _read_again(load, wrong, hints).scene
    except SceneError as error:
        return True, f"refused: {error.problem}"
    expected, viewmats = load.scene.cameras.viewmats, read.cameras.viewmats
    tolerance = 1e-3 * (1 + np.abs(expected).max())
    same = expected.shape == viewmats.shape and np.allclose(expected, viewmats, atol=tolerance)
    return bool(same), "recognised" if same else "taken for something else"


def _check_cameras(case: Case, load: SceneLoad, hints: ReadHints) -> tuple[bool, str]:
    """Read the scene from cameras that are off, with Gaussians that are not."""
    assert load.cameras is not None
    assert case.cameras is not None
    wrong = replace(load.cameras, viewmats=case.cameras(load.cameras.viewmats))
    try:
        read = _read_again(load, wrong, hints)
    except SceneError as error:
        return case.check == "refused", f"refused: {error.problem}"
    if read.alignment is None:
        return False, "taken for an unaligned scene"
    return case.check == "moved" and read.alignment.ok, f"{read.alignment.worst_px:.2f} px from the pixels"


def _read_again(load: SceneLoad, cameras: CameraFile, hints: ReadHints) -> SceneLoad:
    """Read the scene's own file with other cameras."""
    opacity: OpacityChoice = "raw" if load.ply.opacity_encoding == "raw" else "logit"
    return align_scene(read_ply_with_hints(load.files, opacity=opacity, hints=hints), load.files, cameras, hints=hints)


def _find_defect(gaussians: Gaussians, scene: Scene) -> str | None:
    """Say what is wrong with a result for any scene; None where nothing is."""
    for name in _FIELDS:
        if not np.isfinite(getattr(gaussians, name)).all():
            return f"{name} are not finite"
    if not 1 <= len(gaussians) <= scene.num_gaussians:
        return f"{len(gaussians)} Gaussians of {scene.num_gaussians}"
    if not ((gaussians.opacities > 0) & (gaussians.opacities < 1)).all():
        return "opacities outside of 0 to 1"
    if not (gaussians.scales > 0).all():
        return "scales that are not positive"
    lengths = np.linalg.norm(gaussians.quats, axis=1)
    return None if np.abs(lengths - 1).max() < 1e-4 else "quaternions that are no unit quaternions"
