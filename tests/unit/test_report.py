from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from gsmerge import report
from gsmerge.pipeline import CompactOptions, CompactReport


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    before, after = tmp_path / "scene.ply", tmp_path / "small.ply"
    before.write_bytes(b"x" * 2_500_000)
    after.write_bytes(b"y" * 700)
    return before, after


def make_document(files: tuple[Path, Path], **changes: Any) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "num_input": 1000,
        "num_output": 25,
        "seconds": {"segment": 1.0, "encode": 0.5},
        "psnr_before": 20.0,
        "psnr_after": 24.5,
        "choices": {"merge": "wide", "merge_scores": {"wide": float("inf")}},
        "notes": ["a note"],
        "options": CompactOptions(seed=5).to_dict(),
        "peak_memory_bytes": 10**9,
    }
    return report.report_document(
        CompactReport(**{**numbers, **changes}),
        input_path=files[0],
        output_path=files[1],
        seconds_before={"read": 0.25},
        seconds_after={"write": 0.125},
    )


def test_document_is_strict_json(files: tuple[Path, Path]) -> None:
    document = json.loads(report.to_json(make_document(files)))
    assert document["choices"]["merge_scores"]["wide"] is None  # infinity is no JSON
    assert document["input"]["sha256"] == hashlib.sha256(b"x" * 2_500_000).hexdigest()
    assert document["ratio"] == 0.025
    assert list(document["seconds"]) == ["read", "segment", "encode", "write"]
    assert document["total_seconds"] == 1.875
    assert document["seed"] == 5


def test_summary_line(files: tuple[Path, Path]) -> None:
    line = report.summary_line(make_document(files))
    assert line == (
        f"{files[1]}: 1,000 -> 25 Gaussians (2.50 %), 2.5 MB -> 700 B; input views 20.00 -> 24.50 dB;"
        " 1.9 s (read 0.25, segment 1.00, encode 0.50, write 0.12)"
    )


def test_summary_line_without_photos(files: tuple[Path, Path]) -> None:
    assert "dB" not in report.summary_line(make_document(files, psnr_before=None, psnr_after=None))


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (1_234_567, "1.2 MB"), (7e9, "7.0 GB"), (2e12, "2000.0 GB")],
)
def test_human_bytes(count: float, text: str) -> None:
    assert report.human_bytes(count) == text


def plan(*, photos: bool = True, views: int = 12, wanted: int | None = None, **settings: Any) -> dict[str, Any]:
    options = CompactOptions().with_settings(settings)
    return report.plan_document(
        {"ply": "scene.ply", "cameras": "transforms.json", "images": None},
        (views, 100, 200),
        options.resolved(photos=photos),
        output_path=Path("small.ply"),
        per_view=800,
        photos=photos,
        threads=2,
        fit_steps=options.fit.steps,
        usual=views * 800 * options.decode.k,
        wanted=wanted,
    )


def test_plan_counts() -> None:
    assert plan(k=2)["output"]["num_gaussians_at_most"] == 12 * 800 * 2
    assert plan(views=1, k=8)["output"]["num_gaussians_at_most"] == 6400
    assert plan()["input"]["num_gaussians"] == 240_000
    assert plan(budget="auto")["output"]["num_gaussians_at_most"] == 12 * 800


def test_plan_of_a_budget() -> None:
    document = plan(budget="2%", wanted=4800)
    assert document["output"]["num_gaussians_at_most"] == 4800
    assert document["superpixels_per_view"] is None
    assert any("at most 4,800" in line for line in report.plan_lines(document))
    assert all(report.plan_lines(plan(budget="auto")))


def test_plan_says_what_will_not_run() -> None:
    def told(**settings: Any) -> tuple[bool, str]:
        document = plan(**settings)
        return document["robust"], document["fit"]

    assert told() == (False, "full")
    assert told(fit="color") == (True, "color")
    assert told(fit="color", robust=False) == (False, "color")
    assert told(fit="none", effort="draft") == (False, "none")
    assert told(robust=True) == (True, "full")
    assert told(photos=False) == (False, "none")
    assert told(photos=False, robust=True) == (False, "none")


def test_plan_of_less_work_takes_less() -> None:
    full, lean = plan()["estimate"], plan(robust=False, fit="none")["estimate"]
    assert lean["seconds"] < full["seconds"]
    assert plan(photos=False)["estimate"]["memory_bytes"] < full["memory_bytes"]
    assert all(line for line in report.plan_lines(plan()))
