"""Ticks, and the key with the names of the lines."""

from __future__ import annotations

import pytest

from gsmerge.research.charts.draw.figures import _draw_curves, common_styles, format_tick, line_styles, log_ticks
from gsmerge.research.charts.figures import BreakEven, Curves, Panel, main_and_all
from gsmerge.research.charts.series import Line, Point
from gsmerge.research.charts.statistics import Interval

METHODS = ("gsmerge", "voxel")


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


def test_no_two_lines_have_one_colour_and_mark() -> None:
    names = [(f"{name} {i}", name == "gsmerge") for name in METHODS for i in range(20)]
    styles = line_styles([("input", False), *names])
    assert len({(style.color, style.marker) for style in styles.values()}) == 41


def line(name: str, *quality: float) -> Line:
    points = (Point(f"{i} %", i + 1.0, Interval(y, y, y, 1), {}) for i, y in enumerate(quality))
    return Line(name, name.startswith("gsmerge"), tuple(points))


def test_main_lines_are_one_for_each_method() -> None:
    """The best of those with several points; a figure with no more stays alone."""
    lines = (
        line("gsmerge", 20, 21), line("gsmerge, fast", 19, 20, 20), line("gsmerge, best", 30), line("voxel, a", 9, 9),
        line("voxel, b", 10, 12),
    )  # fmt: skip
    panels = (Panel("PSNR", True, lines), Panel("SSIM", True, lines[1:]))
    main, whole = main_and_all(Curves("quality-ratio", "", "Words.", "", panels))
    assert isinstance(main, Curves)
    assert isinstance(whole, Curves)
    assert [[one.name for one in panel.lines] for panel in main.panels] == [["gsmerge", "voxel, b"], ["voxel, b"]]
    assert (whole.name, whole.all_of, whole.panels) == ("quality-ratio-all", "quality-ratio", panels)
    worst = main_and_all(Curves("quality-ratio", "", "", "", (Panel("LPIPS", False, lines),)))[0]
    assert isinstance(worst, Curves)
    assert [one.name for one in worst.panels[0].lines] == ["gsmerge, fast", "voxel, a"]
    assert main_and_all(main) == [main]
    rows = (("gsmerge", 1.0, 5.0, 20.0), ("gsmerge, fast", 0.5, 5.0, 9.0), ("voxel", 0.1, 5.0, 2.0))
    even, all_rows = main_and_all(BreakEven("break-even", "", "", 60.0, rows))
    assert isinstance(even, BreakEven)
    assert even.rows == (rows[0], rows[2])
    assert all_rows == BreakEven("break-even-all", "", "", 60.0, rows, "break-even")
