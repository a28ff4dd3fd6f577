from __future__ import annotations

import json
import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hostile.gsm_files import (
    UNREADABLE,
    Spoil,
    assert_refused_in_one_line,
    entry,
    filled,
    of_arrays,
    with_array,
    with_header,
    with_text,
)
from network_fixtures import SMALL, noisy, written
from safetensors.numpy import load_file, save_file

import gsmerge
from gsmerge.errors import SceneError
from gsmerge.networks.checkpoint import SHIPPED, find_checkpoint, load_checkpoint

NAME = "encoder.latent.weight"


def write_archive(path: Path) -> None:
    """As torch saves its files."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("archive/data.pkl", pickle.dumps({"a": 1}))


DAMAGED: dict[str, Spoil] = {
    **UNREADABLE,
    "a torch file": write_archive,
    "another program's": with_text("{}", "networks"),
    "another schema": with_header(schema=1),
    "no version": with_header(gsmerge=None),
    "no options": with_header(options=None),
    "unknown options": with_header(options={"depth": 3}),
    "enormous options": with_header(options={"width": 1000000000}),
    "options of another type": with_header(options={"width": "48"}),
    "bounds that bound nothing": with_header(options={"bounds": {"mean": 1e9}}),
    "bounds that are no table": with_header(options={"bounds": 3}),
    "unknown bounds": with_header(options={"bounds": {"far": 1.0}}),
    "other sizes": with_header(options={"width": 64}),
    "training that is no table": with_header(training=3),
    "a tensor too many": lambda path: save_file(
        load_file(path) | {"more": np.ones(1, np.float32)}, path, metadata(path)
    ),
    **of_arrays([NAME], [NAME]),
    "infinity": with_array(NAME, filled(float("inf"))),
}


def metadata(path: Path) -> dict[str, str]:
    form, said = entry(path)
    return {form: json.dumps(said)}


def test_round_trip(tmp_path: Path) -> None:
    networks = noisy()
    checkpoint = load_checkpoint(written(tmp_path / "a.safetensors", noisy()))
    assert checkpoint.networks.options == SMALL
    assert checkpoint.version == gsmerge.__version__
    assert checkpoint.facts()["training"] == {"steps": 0}
    assert checkpoint.facts()["num_parameters"] == networks.num_parameters
    assert checkpoint.networks.arrays.keys() == networks.arrays.keys()
    for name, array in networks.arrays.items():
        assert np.array_equal(checkpoint.networks.arrays[name], array)
    assert os.listdir(tmp_path) == ["a.safetensors"]


def test_the_same_networks_give_the_same_bytes(tmp_path: Path) -> None:
    a, b = (written(tmp_path / name, noisy()).read_bytes() for name in ("a", "b"))
    assert a == b


@pytest.mark.parametrize("damage", DAMAGED)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    path = written(tmp_path / "a.safetensors", noisy())
    DAMAGED[damage](path)
    assert "expected" in assert_refused_in_one_line(load_checkpoint, path)
    with pytest.raises(SceneError):
        find_checkpoint(str(path), required=False)


def test_none_is_nothing() -> None:
    assert find_checkpoint("none", required=False) == (None, [])


def test_what_ships_says_what_it_is() -> None:
    checkpoint, notes = find_checkpoint("shipped", required=True)
    assert notes == []
    assert SHIPPED.stat().st_size < 8e6
    facts = checkpoint.facts()
    assert facts["checkpoint"] == "shipped"  # no path of the machine in a report
    assert {"options", "data", "validation", "step"} <= facts["training"].keys()
    assert "/" not in json.dumps(facts["training"])
