"""Ticks, and the key with the names of the lines."""

from __future__ import annotations

import pytest

from gsmerge.research.charts.draw.figures import _draw_curves, common_styles, format_tick, log_ticks
from gsmerge.research.charts.figures import Curves, Panel
from gsmerge.research.charts.series import Line, Point
from gsmerge.research.charts.statistics import Interval


def test_ticks_are_round() -> None:
    assert log_ticks(0.4, 25) == pytest.approx([0.5, 1, 2, 5, 10, 20])
    assert log_ticks(0.001, 3000) == pytest.approx([0.001, 0.01, 0.1, 1, 10, 100, 1000])
    assert [format_tick(v) for v in (0.5, 20, 1000, 2500, 5e5, 2e6)] == ["0.5", "20", "1k", "2.5k", "500k", "2M"]


@pytest.mark.parametrize("count", [1, 3, 10, 25])
def test_the_key_names_every_line_and_fits(count: int) -> None:
    """The reference is a name, too."""
    points = [(Interval(20 + i, 19 + i, 21 + i, 4), 0.1 * (i + 1)) for i in range(count)]
    lines = tuple(Line(f"method {i}", i == 0, (Point("1%", x, y, {}),)) for i, (y, x) in enumerate(points))
    panels = tuple(Panel(word, True, lines, ("input", 22.0)) for word in ("PSNR", "SSIM"))
    figure = Curves("quality", "Quality", "", "Seconds", panels)
    fig = _draw_curves(figure, common_styles([figure]))
    fig.draw_without_rendering()
    (key,) = fig.legends
    assert [text.get_text() for text in key.get_texts()] == [*(line.name for line in lines), "input"]
    box = key.get_window_extent()
    assert fig.bbox.x0 <= box.x0 < box.x1 <= fig.bbox.x1
    assert fig.bbox.y0 <= box.y0 < box.y1 <= fig.bbox.y1
    assert all(axes.bbox.x1 <= box.x0 for axes in fig.axes)
