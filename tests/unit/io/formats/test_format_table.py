"""The tables of formats name functions that exist."""

from __future__ import annotations

from functools import partial

import pytest

from gsmerge.io.cameras import read_cameras as camera_reader
from gsmerge.io.cameras import table as camera_table
from gsmerge.io.cameras.table import CAMERA_FORMATS
from gsmerge.io.cameras.view_layout import ViewLayout
from gsmerge.io.formats import glb, sog, splat, spz, streamed
from gsmerge.io.formats.table import FORMATS, LEVELS
from gsmerge.runtime.plugins import LazyFunction

LAYOUTS = [row.read for row in CAMERA_FORMATS if isinstance(row.read, ViewLayout)]
ENTRIES = [
    entry
    for table in (*FORMATS, *CAMERA_FORMATS, *LAYOUTS, camera_reader, camera_table)
    for entry in vars(table).values()
]
FUNCTIONS = [entry.func if isinstance(entry, partial) else entry for entry in ENTRIES]


@pytest.mark.parametrize(
    "function", sorted({entry for entry in FUNCTIONS if isinstance(entry, LazyFunction)}, key=str), ids=str
)
def test_functions_that_a_table_names_exist(function: LazyFunction) -> None:
    assert callable(function.load())


def test_degrees_of_the_table_are_those_of_the_writers() -> None:
    writers = {".sog": sog, ".splat": splat, ".spz": spz, ".glb": glb}
    degrees = {ending: writer.MAX_DEGREE for ending, writer in writers.items()}
    assert {row.ending: row.max_degree for row in FORMATS if row.ending in degrees} == degrees
    assert LEVELS.max_degree == streamed.MAX_DEGREE
