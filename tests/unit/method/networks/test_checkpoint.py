"""Networks are written to a checkpoint and read back."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from network_fixtures import SMALL, noisy, written

import gsmerge
from gsmerge.method.networks.checkpoint import SHIPPED
from gsmerge.reading.checkpoint import find_checkpoint, load_checkpoint


def test_written_checkpoint_is_read_back(tmp_path: Path) -> None:
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


def test_same_networks_are_written_as_the_same_bytes(tmp_path: Path) -> None:
    a, b = (written(tmp_path / name, noisy()).read_bytes() for name in ("a", "b"))
    assert a == b


def test_checkpoint_none_means_no_networks() -> None:
    assert find_checkpoint("none", required=False) == (None, [])


def test_shipped_checkpoint_says_what_it_is() -> None:
    checkpoint, notes = find_checkpoint("shipped", required=True)
    assert notes == []
    assert SHIPPED.stat().st_size < 8e6
    facts = checkpoint.facts()
    assert facts["checkpoint"] == "shipped"  # no path of the machine in a report
    assert {"options", "data", "validation", "step"} <= facts["training"].keys()
    assert "/" not in json.dumps(facts["training"])
