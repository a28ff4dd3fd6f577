"""Figures as PNG and SVG; the only part that knows matplotlib, which is an optional extra."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.errors import GsmergeError

if TYPE_CHECKING:
    from gsmerge.research.charts.figures import Figure

INSTALL_HINT = 'pip install "matplotlib>=3.8,<4"'  # as the extra chart asks for


def require_matplotlib() -> None:
    """Raise a GsmergeError that says how to install matplotlib where it is missing."""
    if find_spec("matplotlib") is None:
        raise GsmergeError(f"charts need matplotlib, which is not installed: {INSTALL_HINT}")


def draw_figures(figures: Sequence[Figure], folder: Path) -> dict[str, str]:
    """Draw figures into a folder, each as ``NAME.png`` and ``NAME.svg``, and return the SVG of each by name.

    The same numbers give the same bytes.
    """
    require_matplotlib()
    from gsmerge.io import atomic_output
    from gsmerge.research.charts.draw.figures import common_styles, draw

    folder.mkdir(parents=True, exist_ok=True)
    drawn, styles = {}, common_styles(figures)
    for figure in figures:
        png, svg = draw(figure, styles)
        for suffix, data in (("png", png), ("svg", svg)):
            with atomic_output(folder / f"{figure.name}.{suffix}", overwrite=True) as temporary:
                temporary.write_bytes(data)
        drawn[figure.name] = svg.decode()
    return drawn
