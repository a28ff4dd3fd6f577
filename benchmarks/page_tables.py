"""Tables of Markdown for the pages."""

from __future__ import annotations

from collections.abc import Sequence

Row = Sequence[str]


def make_table(head: Row, rows: Sequence[Row]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)
