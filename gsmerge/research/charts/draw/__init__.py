"""Figures as PNG and SVG; the only part that knows matplotlib, which is an optional extra."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.errors import GsmergeError

if TYPE_CHECKING:
    from gsmerge.research.charts.figures import Figure

INSTALL_HINT = 'pip install "gsmerge[chart]"'


def require_matplotlib() -> None:
    """Say how to install matplotlib where it is missing.

    Raises:
        GsmergeError: If it is.
    """
    if find_spec("matplotlib") is None:
        raise GsmergeError(f"charts need matplotlib, which is not installed: {INSTALL_HINT}")


def draw_figures(figures: Sequence[Figure], folder: Path) -> dict[str, str]:
    """Draw figures into a folder, each as ``NAME.png`` and ``NAME.svg``; the same numbers give the same bytes.

    Returns:
        The SVG of each by name.

    Raises:
        GsmergeError: If matplotlib is not installed.
        SceneError: If a file cannot be written.
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
