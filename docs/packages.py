"""Draw the picture of the two parts of the package, docs/images/packages.svg, from the import contracts.

python docs/packages.py          # write the picture if it differs
python docs/packages.py --check  # only name it; the exit code is 1 if it differs

The order of the boxes is that of the contracts "Imports flow down" and "Imports of the method flow down" in
pyproject.toml; what each is for stands in the tables of docs/internals/architecture.md.
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Iterator
from html import escape
from pathlib import Path

import tomllib

DOCS = Path(__file__).parent
PAGE = DOCS / "internals" / "architecture.md"
PICTURE = DOCS / "images" / "packages.svg"
PROJECT = DOCS.parent / "pyproject.toml"
# Sizes in pixels: a box, the gap below it, the distance of the columns, a line of text, and the margin
WIDTH, GAP, APART, LINE, MARGIN = 440, 6, 60, 15, 20
COLUMNS = 62  # characters of a line of text in a box
TITLES = {  # of each column, with the fill of its boxes
    "Decides, and knows files": "#e8eef7",
    "The method: arrays alone": "#e9f5ea",
    "Shared by both": "#f2f2f2",
}
NOTE = "Each may import only those below it. The method imports nothing of the left."


def main() -> int:
    """Write or check the picture; return the exit code."""
    picture = draw_picture()
    if PICTURE.exists() and PICTURE.read_text("utf-8") == picture:
        return 0
    print(f"{PICTURE.name} differs from the contracts: python docs/packages.py")
    if "--check" in sys.argv:
        return 1
    PICTURE.write_text(picture, "utf-8", newline="\n")
    return 0


def layers(title: str) -> list[str]:
    """Return the names of an import contract, from the top."""
    contracts = tomllib.loads(PROJECT.read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    (contract,) = [one for one in contracts if one["name"] == title]
    return [name for layer in contract["layers"] for name in layer.split(" | ")]


def purposes() -> dict[str, str]:
    """Return what each package and module is for, from the tables of the page, without their markup."""
    rows = re.findall(r"^\| `([\w/]+)` \| ([^|]+) \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    return {name.rstrip("/"): re.sub(r"\[([^]]*)\]\([^)]*\)|`", r"\1", text) for name, text in reversed(rows)}


def draw_picture() -> str:
    """Return the picture as SVG: a column for each part, and below them what both use."""
    packages = layers("Imports flow down")
    at = packages.index("method")
    texts = purposes()
    top, bottom = MARGIN + LINE, [0, 0]
    shapes = [f'<text x="{MARGIN}" y="{MARGIN}">{NOTE}</text>']
    for column, names in enumerate((packages[:at], layers("Imports of the method flow down"))):
        left = MARGIN + column * (WIDTH + APART)
        bottom[column] = draw_column(shapes, {name: texts[name] for name in names}, list(TITLES)[column], left, top)
    shared = {name: texts[name] for name in packages[at + 1 :]}
    bottom[1] = draw_column(shapes, shared, list(TITLES)[2], MARGIN + WIDTH + APART, bottom[1] + LINE)
    middle = MARGIN + WIDTH + APART / 2
    shapes.append(f'<text x="{middle}" y="{top + 4 * LINE}" text-anchor="middle" font-size="26">→</text>')
    shapes.append(f'<text x="{middle}" y="{top + 5 * LINE}" text-anchor="middle">imports</text>')
    size = f'width="{2 * (WIDTH + MARGIN) + APART}" height="{max(bottom) + MARGIN}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">'
    return "\n".join([head, '<rect width="100%" height="100%" fill="white"/>', *shapes, "</svg>", ""])


def draw_column(shapes: list[str], texts: dict[str, str], title: str, left: int, top: int) -> int:
    """Add a title, and a box for each name with its text, to ``shapes``; return where the column ends, in pixels."""
    shapes.append(f'<text x="{left}" y="{top + LINE}" font-size="15" font-weight="bold">{escape(title)}</text>')
    top += LINE + 2 * GAP
    for name, text in texts.items():
        lines = list(wrap(name, text))
        height = LINE * len(lines) + GAP
        fill = TITLES[title]
        shapes.append(
            f'<rect x="{left}" y="{top}" width="{WIDTH}" height="{height}" rx="4" fill="{fill}" stroke="#999"/>'
        )
        for number, line in enumerate(lines, 1):
            bold = f'<tspan font-weight="bold">{name}</tspan>' if number == 1 else ""
            shapes.append(f'<text x="{left + 8}" y="{top + number * LINE - 1}">{bold}{escape(line)}</text>')
        top += height + GAP
    return top


def wrap(name: str, text: str) -> Iterator[str]:
    """Return the lines of text of a box, of which the first begins behind the name."""
    first, *rest = textwrap.wrap(f"{name}  {text}", COLUMNS, drop_whitespace=True)
    yield first.removeprefix(name)
    yield from rest


if __name__ == "__main__":
    sys.exit(main())
