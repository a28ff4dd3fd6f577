"""These records are of made-up experiments."""

from __future__ import annotations

from typing import Any

from gsmerge.method.kernels import elementary
from gsmerge.research.charts.measure_run import RunRecord, describe_run

SCENES = ("apples", "fern", "fox")
LEVELS = {"apples": 2.0, "fern": 0.0, "fox": -3.0}  # how hard a scene is, dB
GAINS = {"gsmerge": 24.0, "greedy": 17.0, "random": 12.0, "input": 18.0}
LN2 = elementary.log(2)


def make_record(scene: str, method: str, settings: dict[str, Any] | None = None) -> RunRecord:
    """Make a run whose numbers follow from its settings: PSNR rises by 0.5 dB with each doubling of the budget."""
    settings = settings or {}
    ratio = float(settings["budget"].rstrip("%")) / 100 if "budget" in settings else 1.0 if method == "input" else 0.044
    quality = GAINS[method] + LEVELS[scene] + 0.5 * elementary.log(ratio / 0.044) / LN2 * (method != "input")
    quality += 0.01 * SCENES.index(scene) - 3 * (settings.get("fit") == "none")
    scores = {
        "psnr_target_visible": quality,
        "ssim_target_visible": 0.5 + quality / 80,
        "lpips_vgg_target_visible": 0.8 - quality / 50,
        "psnr_context": quality + 2,
    }
    label, seconds = describe_run(method, settings), 0.0 if method == "input" else 6 * (ratio / 0.044) ** 0.2
    return RunRecord(
        scene, label, f"{scene} {label}", method, settings, 12_000, round(12_000 * ratio), 800, seconds, scores
    )


def make_grid(budgets: tuple[str, ...] = ("1%", "4.4%", "20%")) -> list[RunRecord]:
    """Make runs of three scenes: the input, ours with and without a fit, and two baselines."""
    records = []
    for scene in SCENES:
        records.append(make_record(scene, "input"))
        for budget in budgets:
            for method in ("gsmerge", "greedy", "random"):
                records.append(make_record(scene, method, {"budget": budget}))
            records.append(make_record(scene, "gsmerge", {"budget": budget, "fit": "none"}))
    return records
