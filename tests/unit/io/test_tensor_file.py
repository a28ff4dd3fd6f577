"""Safetensors files are read as by the library's own reader, or refused."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import refuses
from safetensors.numpy import load_file, save_file

from gsmerge.errors import SceneError
from gsmerge.io import tensor_file
from gsmerge.io.tensor_file import read_tensors

REMEDY = "name another"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    types = (np.float64, np.float32, np.float16, np.int64, np.int32, np.int16, np.int8, np.uint64, np.uint8, np.bool_)
    arrays = {f"a.{np.dtype(kind)}": rng.uniform(0, 99, (50, 400)).astype(kind) for kind in types}
    path = tmp_path / "a.gsm"
    save_file(arrays | {"a.none": np.zeros((3, 0), np.float32), "b": np.ones(2)}, path, {"of": "a test"})
    return path


def test_arrays_are_those_that_the_safetensors_library_reads(path: Path) -> None:
    metadata, arrays = read_tensors(path, "a file", REMEDY)
    expected = load_file(path)
    assert metadata == {"of": "a test"}
    assert arrays.keys() == expected.keys()
    for name, array in arrays.items():
        assert (array.dtype, array.shape) == (expected[name].dtype, expected[name].shape), name
        np.testing.assert_array_equal(array, expected[name], name)


def test_a_tensor_file_that_shrinks_while_it_is_read_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, not the signal that reading mapped pages beyond the end would be."""
    parse = tensor_file.parse_json

    def parse_then_cut(*arguments: Any) -> Any:
        os.truncate(path, path.stat().st_size // 2)
        return parse(*arguments)

    monkeypatch.setattr(tensor_file, "parse_json", parse_then_cut)
    with refuses(SceneError, path, "a file", REMEDY):
        read_tensors(path, "a file", REMEDY)


@pytest.mark.parametrize(
    ("head", "found"),
    [
        ({"a": {"dtype": "BF16", "shape": [1], "data_offsets": [0, 2]}}, "BF16"),
        # Each of 55 bytes, of which the reader would make 1.7 kB
        ({f"{i}": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for i in range(100_000)}, "arrays"),
    ],
    ids=["a type that NumPy lacks", "more arrays than a file may have"],
)
def test_headers_that_are_not_read_are_refused(head: dict[str, object], found: str, tmp_path: Path) -> None:
    path, text = tmp_path / "a.gsm", json.dumps(head).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(2))
    with refuses(SceneError, path, found):
        read_tensors(path, "a file", REMEDY)
