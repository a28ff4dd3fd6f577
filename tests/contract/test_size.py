"""Every room keeps to its budget of statements, which docs/internals/size.md states."""

from __future__ import annotations

import re

import pytest
from statements import ROOT, count_rooms

PAGE = ROOT / "docs" / "internals" / "size.md"
BUDGETS = {
    name: int(number.replace(",", ""))
    for name, number in re.findall(r"^\| ([^|]+?) \| ([\d,]+) \|", PAGE.read_text("utf-8"), re.MULTILINE)
}
COUNTS = count_rooms()


def test_every_room_has_a_budget() -> None:
    assert set(BUDGETS) == set(COUNTS)


@pytest.mark.parametrize("room", sorted(COUNTS))
def test_a_room_keeps_to_its_budget(room: str) -> None:
    assert COUNTS[room] <= BUDGETS[room], f"{room} has grown: take something out, or raise its number with a reason"


@pytest.mark.parametrize("room", sorted(COUNTS))
def test_a_budget_leaves_no_more_than_a_hundredth(room: str) -> None:
    """What a change takes out is taken from the budget as well, so that it is not spent again."""
    assert BUDGETS[room] <= 1.01 * COUNTS[room] + 5
