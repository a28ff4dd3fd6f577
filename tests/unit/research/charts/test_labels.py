"""Names beside lines: apart from each other, near where they belong."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.research.charts.draw.figures import CROWDED, _draw_curves, common_looks
from gsmerge.research.charts.draw.labels import spread
from gsmerge.research.charts.draw.style import log_ticks, number
from gsmerge.research.charts.figures import Curves, Panel
from gsmerge.research.charts.series import Line, Point
from gsmerge.research.charts.statistics import Interval


def test_places_that_are_far_enough_stay() -> None:
    assert spread([0.9, 0.1, 0.5], 0.1) == pytest.approx([0.9, 0.1, 0.5])
    assert spread([], 0.1) == []


def test_places_that_touch_are_moved_apart_evenly() -> None:
    assert spread([0.5, 0.5], 0.1) == pytest.approx([0.45, 0.55])
    assert spread([0.5, 0.52, 0.9], 0.1) == pytest.approx([0.46, 0.56, 0.9])


def test_places_are_apart_in_order_and_near() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        wanted = rng.uniform(0, 1, rng.integers(2, 9)).tolist()
        placed = spread(wanted, 0.07)
        order = np.argsort(wanted, kind="stable")
        assert (np.diff(np.array(placed)[order]) >= 0.07 - 1e-9).all()
        assert np.mean(placed) == pytest.approx(np.mean(wanted))


def test_ticks_are_round() -> None:
    assert log_ticks(0.4, 25) == pytest.approx([0.5, 1, 2, 5, 10, 20])
    assert log_ticks(0.001, 3000) == pytest.approx([0.001, 0.01, 0.1, 1, 10, 100, 1000])
    assert [number(v) for v in (0.5, 20, 1000, 2500, 5e5, 2e6)] == ["0.5", "20", "1k", "2.5k", "500k", "2M"]


@pytest.mark.parametrize(("count", "keys"), [(3, 0), (CROWDED - 1, 0), (CROWDED, 1), (25, 1)])
def test_many_names_stand_in_a_key_that_fits(count: int, keys: int) -> None:
    """The reference is a name, too."""
    points = [(Interval(20 + i, 19 + i, 21 + i, 4), 0.1 * (i + 1)) for i in range(count)]
    lines = tuple(Line(f"method {i}", i == 0, (Point("1%", x, y, {}),)) for i, (y, x) in enumerate(points))
    panels = tuple(Panel(word, True, lines, ("input", 22.0)) for word in ("PSNR", "SSIM"))
    figure = Curves("quality", "Quality", "", "Seconds", panels)
    canvas = _draw_curves(figure, common_looks([figure]))
    assert len(canvas.legends) == keys
    canvas.draw_without_rendering()
    for key in canvas.legends:
        assert [text.get_text() for text in key.get_texts()] == [*(line.name for line in lines), "input"]
        box = key.get_window_extent()
        assert canvas.bbox.x0 <= box.x0 < box.x1 <= canvas.bbox.x1
        assert canvas.bbox.y0 <= box.y0 < box.y1 <= canvas.bbox.y1
        assert all(axes.bbox.x1 <= box.x0 for axes in canvas.axes)
