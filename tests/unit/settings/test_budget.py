"""A budget, a file size or a device means a number of Gaussians."""

from __future__ import annotations

import pytest
from messages import refuses

from gsmerge.settings.budget import parse_budget, parse_bytes


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("40000", 40_000),
        (40000, 40_000),
        ("40_000", 40_000),
        (" 2% ", 20_000),
        ("2.5 %", 25_000),
        (".1%", 1000),
        ("29%", 290_000),  # 0.29 * 1e6 is not a whole number in floating point
        ("0.00019%", 1),
        ("100%", 1_000_000),
        ("3000000", 1_000_000),
        ("40k", 40_000),
        ("0.5M", 500_000),
        ("40,000", 40_000),
        ("4e4", 40_000),
    ],
)
def test_budgets_are_read_as_counts_of_gaussians(text: str | int, count: int) -> None:
    assert parse_budget(text, 1_000_000) == count


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["", "many", "-5", "2.5", "5%%", "4,4%", "40,00", "1e10", "2.5e", "%", "4٤", "nan", "inf%"], '"40000"'),
        (["0", "0%", "0.01%"], "one Gaussian"),
        (["101%"], "100%"),
    ],
    ids=["none", "nothing", "above everything"],
)
def test_impossible_budgets_are_refused(texts: list[str], expected: str) -> None:
    for text in texts:
        with refuses(ValueError, "budget", expected, f"'{text}'"):
            parse_budget(text, 1000)


@pytest.mark.parametrize(
    ("text", "size"),
    [("5MB", 5_000_000), ("5 mb", 5_000_000), ("1.5KiB", 1536), ("77", 77), (77, 77), ("2GB", 2 * 10**9)],
)
def test_sizes_are_read_as_bytes(text: str | int, size: int) -> None:
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["", "MB", "5 XB", "-5MB", "5MBB", "1e6"])
def test_impossible_sizes_are_refused(text: str) -> None:
    with refuses(ValueError, "budget", '"5MB"', f"'{text}'"):
        parse_bytes(text)
