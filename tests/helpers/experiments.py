"""Records of made-up experiments."""

from __future__ import annotations

from typing import Any

from gsmerge.kernels import elementary
from gsmerge.research.charts.measure_run import RunRecord, describe

SCENES = ("apples", "fern", "fox")
LEVELS = {"apples": 2.0, "fern": 0.0, "fox": -3.0}  # how hard a scene is, dB
GAINS = {"gsmerge": 24.0, "voxel": 17.0, "random": 12.0, "input": 18.0}
LN2 = elementary.log(2)
TIMES = {"gsmerge": 6.0, "voxel": 0.6, "random": 0.1, "input": 0.0}


def make_record(scene: str, method: str, settings: dict[str, Any] | None = None, **changes: Any) -> RunRecord:
    """A run whose numbers follow from its settings: PSNR rises by 0.5 dB with each doubling of the budget."""
    settings = settings or {}
    ratio = float(settings["budget"].rstrip("%")) / 100 if "budget" in settings else 1.0 if method == "input" else 0.044
    views_asked = changes.pop("views_asked", None)
    views = views_asked or 12
    wobble = 0.01 * (SCENES.index(scene) if scene in SCENES else 0)
    quality = (
        GAINS[method]
        + LEVELS.get(scene, 0.0)
        + 0.5 * elementary.log(ratio / 0.044) / LN2 * (method != "input")
        + wobble
    )
    quality -= 3 * (settings.get("fit") == "none") + 0.5 * elementary.log(12 / views) / LN2
    seconds = TIMES[method] * (ratio / 0.044) ** 0.2
    label = describe(method, settings, views_asked)
    values: dict[str, Any] = {
        "scene": scene,
        "label": label,
        "output": f"{scene}/{label}",
        "scene_sha256": scene * 16,
        "method": method,
        "settings": settings,
        "views_asked": views_asked,
        "command": "gsmerge lab chart scenes --grid budget=1%,4.4%",
        "environment": {"processor": "one", "python": "3.11"},
        "views": views,
        "num_input": views * 1000,
        "count": round(views * 1000 * ratio),
        "bytes": round(68_000 * views * ratio),
        "seconds": seconds,
        "stages": {} if method == "input" else {"segment": 0.2 * seconds, "fit": 0.8 * seconds, "score": 0.5},
        "render_ms": 60.0 if method == "input" else 5.0,
        "scores": {
            "psnr_target_visible": quality,
            "ssim_target_visible": 0.5 + quality / 80,
            "lpips_vgg_target_visible": 0.8 - quality / 50,
            "psnr_context": quality + 2,
        },
    }
    return RunRecord(**{**values, **changes})


def make_grid(
    budgets: tuple[str, ...] = ("1%", "4.4%", "20%"), views: tuple[int | None, ...] = (None, 3)
) -> list[RunRecord]:
    """Three scenes, the input, ours with and without a fit, and two rivals."""
    records = []
    for scene in SCENES:
        for count in views:
            records.append(make_record(scene, "input", views_asked=count))
            for budget in budgets if count is None else ("4.4%",):
                for method in ("gsmerge", "voxel", "random"):
                    records.append(make_record(scene, method, {"budget": budget}, views_asked=count))
                records.append(make_record(scene, "gsmerge", {"budget": budget, "fit": "none"}, views_asked=count))
    return records
