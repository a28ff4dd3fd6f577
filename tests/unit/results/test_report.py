from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsmerge.results import report
from gsmerge.results.report import CompactReport, Covered, NewViews
from gsmerge.runtime.documents import to_json
from gsmerge.settings.compact import CompactOptions


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
        "choices": {"scored_views": 4, "agreement": {"share": float("inf")}},
        "notes": ["a note"],
        "options": CompactOptions(seed=5).to_dict(),
        "peak_memory_bytes": 10**9,
    }
    return report.report_document(
        CompactReport(**{**numbers, **changes}),
        recognised={"path": str(files[0]), "bytes": 2_500_000},
        output_path=files[1],
        seconds_before={"read": 0.25},
        seconds_after={"write": 0.125},
    )


def test_the_report_document_is_strict_json(files: tuple[Path, Path]) -> None:
    document = json.loads(to_json(make_document(files)))
    assert document["choices"]["agreement"]["share"] is None  # infinity is no JSON
    assert document["ratio"] == 0.025
    assert list(document["seconds"]) == ["read", "segment", "encode", "write"]
    assert document["total_seconds"] == 1.875
    assert document["seed"] == 5


def test_scores_of_covered_pixels_stand_beside_those_of_all_pixels(files: tuple[Path, Path]) -> None:
    document = make_document(files, covered=Covered(0.79, 26.1, 25.9))
    assert document["psnr_covered"] == {"share": 0.79, "before": 26.1, "after": 25.9}
    text = "\n".join(report.result_table(document))
    parts = ("79 % that have Gaussians", "about 26.1 dB", "about 25.9 dB", "about 20.0 dB", "about 24.5 dB")
    assert all(part in text for part in parts)
    assert make_document(files)["psnr_covered"] is None


def test_new_views_come_before_own_photos_in_the_table(files: tuple[Path, Path]) -> None:
    document = make_document(files, new_views=NewViews(17.25, 21.5, 3.0, 5.5, 3))
    assert document["new_views"] == {"before": 17.25, "after": 21.5, "low": 3.0, "high": 5.5, "views": 3}
    table = [" ".join(row.split()) for row in report.result_table(document)]
    place = table.index("new views 17.2 dB 21.5 dB +3.0 to +5.5 dB, by 3 photos left out")
    assert table[place + 1].startswith("its own photos")


def test_the_curve_marks_the_count_nearest_to_the_result(files: tuple[Path, Path]) -> None:
    points = [{"count": count, "psnr": 20.0, "ssim": 0.5} for count in (10, 30, 90)]
    heading, _, few, nearest, many = report.curve_lines(make_document(files, choices={"curve": points}))
    assert "patches of the photos that they left out" in heading
    assert nearest.endswith("nearest to the result: 25")
    assert "result" not in few + many
    pruned = make_document(files, choices={"curve": points, "curve_left_out": 2, "pruned": 4})
    heading, _, few, nearest, many = report.curve_lines(pruned)
    assert "on 2 photos that they left out" in heading
    one = report.curve_lines(make_document(files, choices={"curve": points, "curve_left_out": 1}))
    assert "on 1 photo that they left out" in one[0]
    assert nearest.endswith("nearest to the result: 29, of which 25 are seen")
