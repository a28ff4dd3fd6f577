from __future__ import annotations

import csv
import io

import pytest

from gsmerge import report
from gsmerge.runtime.memory import human_bytes


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (1_234_567, "1.2 MB"), (7e9, "7.0 GB"), (2e12, "2000.0 GB")],
)
def test_human_bytes(count: float, text: str) -> None:
    assert human_bytes(count) == text


def test_text_in_tables_is_no_formula() -> None:
    text = ["=cmd|' x'!A1/s.ply", "+1.ply", "-1.ply", "@a.ply", "plain-1.ply"]
    rows = csv.DictReader(io.StringIO(report.csv_text(["name", "count"], [{"name": x, "count": -1} for x in text])))
    actual = [(row["name"], row["count"]) for row in rows]
    assert actual == [(f"'{x}" if x != "plain-1.ply" else x, "-1") for x in text]
