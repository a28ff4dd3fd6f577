from __future__ import annotations

import pytest

from gsmerge.runtime.documents import text_table
from gsmerge.runtime.memory import human_bytes, human_share


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (1_234_567, "1.2 MB"), (7e9, "7.0 GB"), (2e12, "2000.0 GB")],
)
def test_counts_of_bytes_are_written_with_a_unit(count: float, text: str) -> None:
    assert human_bytes(count) == text


@pytest.mark.parametrize(
    ("share", "text"), [(0, "0.00 %"), (0.044, "4.40 %"), (1, "100.00 %"), (1e-4, "0.01 %"), (3.26e-5, "0.003 %")]
)
def test_shares_are_written_in_percent(share: float, text: str) -> None:
    assert human_share(share) == text


def test_tables_leave_out_columns_that_a_terminal_has_no_room_for() -> None:
    rows = [("result", "Gaussians", "of", "dB"), ("room/small.ply", "52,038", "1,182,720", "28.36")]
    whole = ["result          Gaussians         of     dB", "room/small.ply     52,038  1,182,720  28.36"]
    assert text_table(rows) == text_table(rows, letters=43) == whole
    assert text_table(rows, letters=42, omitted_first=(2,)) == [
        "result          Gaussians     dB",
        "room/small.ply     52,038  28.36",
    ]
    assert text_table(rows, letters=42) == [
        "result         Gaussians         of     dB",
        "room/...l.ply     52,038  1,182,720  28.36",
    ]
    assert text_table(rows, letters=40) == [
        "result          Gaussians         of",
        "room/small.ply     52,038  1,182,720",
    ]
    assert text_table(rows, "  ", letters=25) == ["  result        Gaussians", "  room/....ply     52,038"]
    assert text_table(rows, letters=3)[1] == "room/....ply     52,038"  # the first two always
