"""The tables of formats name functions that exist."""

from __future__ import annotations

from functools import partial

import pytest

from gsmerge.io.cameras import read as camera_reader
from gsmerge.io.cameras.read import CAMERA_FORMATS
from gsmerge.io.formats import glb, sog, splat, spz, streamed, usd
from gsmerge.io.formats.table import FORMATS, LEVELS
from gsmerge.runtime.plugins import LazyFunction

ENTRIES = [entry for row in (*FORMATS, *CAMERA_FORMATS) for entry in vars(row).values()]
FUNCTIONS = [entry.func if isinstance(entry, partial) else entry for entry in (*ENTRIES, *vars(camera_reader).values())]


@pytest.mark.parametrize(
    "function", sorted({entry for entry in FUNCTIONS if isinstance(entry, LazyFunction)}, key=str), ids=str
)
def test_a_function_that_a_table_names_is_there(function: LazyFunction) -> None:
    assert callable(function.load())


def test_the_table_has_the_degrees_of_the_writers() -> None:
    writers = {".sog": sog, ".splat": splat, ".spz": spz, ".glb": glb, ".usdc": usd}
    degrees = {ending: writer.MAX_DEGREE for ending, writer in writers.items()}
    assert {row.ending: row.max_degree for row in FORMATS if row.ending in degrees} == degrees
    assert LEVELS.max_degree == streamed.MAX_DEGREE
