"""HTML from plain values; text from files and names is escaped here."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

_TYPES = {".jpg": "image/jpeg", ".png": "image/png"}
PX_PER_PT = 1.75  # largest magnification of drawings, pixels per point


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str  # not escaped yet
    kind: str = ""  # CSS class


Row = Sequence[str | Cell]


def text(value: object) -> str:
    """Any value as text in HTML or in a quoted attribute."""
    return escape(str(value), quote=True)


def table(head: Sequence[str], rows: Sequence[Row], *, texts: Sequence[int] = (0,), ours: Sequence[int] = ()) -> str:
    """A table; ``texts`` are the columns of text, aligned left, and ``ours`` the rows that are ours."""
    kinds = ["text" if i in texts else "" for i in range(len(head))]
    top = "".join(f'<th scope="col"{_class(kind)}>{text(name)}</th>' for kind, name in zip(kinds, head, strict=True))
    body = []
    for number, row in enumerate(rows):
        cells = [cell if isinstance(cell, Cell) else Cell(cell) for cell in row]
        tags = (f"<td{_class(kind, c.kind)}>{text(c.text)}</td>" for kind, c in zip(kinds, cells, strict=True))
        body.append(f"<tr{_class('ours' if number in ours else '')}>{''.join(tags)}</tr>")
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'


def _class(*names: str) -> str:
    joined = " ".join(name for name in names if name)
    return f' class="{text(joined)}"' if joined else ""


def details(summary: str, content: str) -> str:
    """Content that opens on request."""
    return f"<details><summary>{text(summary)}</summary>{content}</details>"


def data_uri(path: Path) -> str:
    """A picture file as part of the page."""
    return f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def inline_svg(svg: str, name: str, label: str) -> str:
    """A drawing of matplotlib's as part of the page: without prologue, metadata and addresses, scalable.

    ``name`` is put before every id, because a page has several drawings; ``label`` is the alternative text.
    """
    drawing = svg[svg.index("<svg") :]
    drawing = re.sub(r"<metadata>.*?</metadata>", "", drawing, flags=re.DOTALL)
    drawing = re.sub(r"<!--.*?-->", "", drawing, flags=re.DOTALL)
    drawing = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", drawing)
    drawing = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", drawing)
    opening, rest = drawing.split(">", 1)
    box = re.search(r'viewBox="0 0 ([0-9.]+) [0-9.]+"', opening)
    if box is None:
        raise ValueError("expected a drawing with a viewBox from 0 0")
    width = round(PX_PER_PT * float(box[1]))
    style = f'style="max-width:{width}px" role="img" aria-label="{text(label)}"'
    return f"<svg {box[0]} {style}>{rest.strip()}"
