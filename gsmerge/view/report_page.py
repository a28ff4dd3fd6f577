"""A comparison, or pictures alone, as one HTML file that loads nothing: headline, pictures with a swipe, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsmerge.measure.comparison_page import Row, comparison_tables
from gsmerge.measure.preview import to_picture
from gsmerge.report import human_bytes
from gsmerge.view.data import encode_still
from gsmerge.view.page import PICTURES, data_uri, headline_of, render_template

ViewPictures = Sequence[Sequence[tuple[str, np.ndarray]]]  # for each view: text and picture [h,w,3] of each scene
Table = tuple[str, Row, list[Row]]  # heading, columns, rows
EMPTY = ("", "-")  # cells that say nothing


def report_page(document: Mapping[str, Any], pictures: ViewPictures) -> str:
    """The page of a comparison; ``document`` is that of :func:`gsmerge.measure.comparison_page.comparison_document`."""
    before, after = document["before"], document["after"][:1]
    tiles, said = [], ""
    if after:
        means = [result["mean"] for result in document["quality"]["results"][:2]]
        split = "target" if "target" in means[0] else "context"
        psnrs = [mean[split]["psnr_visible"] for mean in means]
        said = headline_of(before["num_gaussians"], after[0]["num_gaussians"], *psnrs)
        speeds = [1000 * side["speeds"][0]["seconds"] for side in (before, *after)]
        tiles = [
            ("Gaussians", f"{before['num_gaussians']:,}", f"{after[0]['num_gaussians']:,}"),
            ("File", human_bytes(before["bytes"]), human_bytes(after[0]["bytes"])),
            ("Render time", f"{speeds[0]:.1f}", f"{speeds[1]:.1f} ms"),
        ]
    title = f"{before['path']}: before and after"
    tables = [without_empty_columns(table) for table in comparison_tables(document)]
    return _page(title, pictures, headline=said or title, tiles=tiles, tables=tables, notes=document["notes"])


def pictures_page(title: str, pictures: ViewPictures) -> str:
    """The pictures alone."""
    return _page(title, pictures, headline=title, tiles=[], tables=[], notes=[])


def _page(title: str, pictures: ViewPictures, **values: Any) -> str:
    views = [
        [(text, data_uri(encode_still(to_picture(image)), "image/webp")) for text, image in one] for one in pictures
    ]
    return render_template("report.html", policy=PICTURES, title=title, views=views, **values)


def without_empty_columns(table: Table) -> Table:
    """A table without columns in which no row says anything."""
    heading, head, rows = table
    kept = [i for i in range(len(head)) if i == 0 or any(row[i] not in EMPTY for row in rows)]
    return heading, [head[i] for i in kept], [[row[i] for i in kept] for row in rows]
