"""A view is found by its name."""

from __future__ import annotations

import pytest
from messages import refuses

from gsmerge.drawing.render_files import find_view
from gsmerge.errors import UsageError

NAMES = ["images/00005.jpg", "images/00006.jpg", "images/00060.jpg", "a/0.png", "view 7"]


@pytest.mark.parametrize(("view", "expected"), [
    ("00006", 1), ("00006.jpg", 1), ("images/00006.jpg", 1), ("6.jpg", 1), ("6", 1), ("060", 2), ("0.png", 3),
    ("view 7", 4), ("000", 3),
])  # fmt: skip
def test_a_view_is_found_by_its_name_or_number(view: str, expected: int) -> None:
    assert find_view(view, NAMES) == expected


@pytest.mark.parametrize("view", ["61.jpg", "5a", "images"])
def test_a_view_of_an_unknown_name_is_refused(view: str) -> None:
    with refuses(UsageError, f"--views {view}", "no view of this name"):
        find_view(view, NAMES)


def test_a_view_of_a_similar_name_is_suggested() -> None:
    with refuses(UsageError, "--views images/00005.jpq", "no view of this name", "perhaps images/00005.jpg"):
        find_view("images/00005.jpq", NAMES[:1])


def test_a_name_of_two_views_is_refused() -> None:
    with refuses(UsageError, "--views 6.jpg", "2 views of this name"):
        find_view("6.jpg", ["a/06.jpg", "b/006.jpg"])
