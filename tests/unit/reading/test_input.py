"""A run reads its scene with notes on what its result will lack."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from messages import noted
from plyfile import PlyData, PlyElement
from tiny_scene import make_tiny

from gsmerge.reading.input import read_input
from gsmerge.reading.scene_files import find_scene_files


@pytest.mark.parametrize(
    ("columns", "lost", "told"),
    [
        (("label", "semantic_0"), ("label", "semantic_0"), ()),
        (("r", "label", "albedo_0"), ("r", "label"), ("albedo_0",)),  # "r" is in words of the note on albedo_0
        (("mat", "albedo_0"), ("mat",), ("albedo_0",)),
        (("cameras", "colors"), (), ("cameras", "colors")),
        (("albedo_0",), (), ("albedo_0",)),
    ],
)
def test_columns_that_a_result_lacks_are_named_once(
    columns: tuple[str, ...], lost: tuple[str, ...], told: tuple[str, ...], tmp_path: Path
) -> None:
    folder = make_tiny().save(tmp_path)
    rows = PlyData.read(folder / "scene.ply")["vertex"].data
    kinds = [(name, "<f4" if name in told else "u1") for name in columns]
    more = np.zeros(len(rows), [*rows.dtype.descr, *kinds])
    for name in rows.dtype.names:
        more[name] = rows[name]
    PlyData([PlyElement.describe(more, "vertex")]).write(folder / "scene.ply")
    notes = read_input(find_scene_files(folder)).notes
    assert not told or noted(notes, "not used", *told)
    lacking = [note for note in notes if noted([note], "gsmerge convert")]
    assert len(lacking) == (1 if lost else 0)
    assert not lost or noted(lacking, *lost)
    assert not any(noted(lacking, name) for name in told)
