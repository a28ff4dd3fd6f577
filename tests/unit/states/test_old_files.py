"""Files that 0.1 wrote: of ``encode``, with networks, and of ``extend``, decoded and with latents."""

from __future__ import annotations

import hashlib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from view_batches import decoded, parts_of, room, same_state

from gsmerge import Compactor, Gaussians
from gsmerge.cli import main
from gsmerge.states.state import DividedGroups, GroupSet
from gsmerge.states.state_file import load_state, save_state

FOLDER = Path(__file__).parent / "old_files"
# Hashes of what 0.1 decoded without a fit, for K = 1 and 2
DECODED = {
    "encoded": ("906ade3d50dfc5bc", "561f06a549e50a31"),
    "state": ("19ed23affa697c03", "03e771f33a589854"),
    "latents": ("5d40a36d13482e04", "c774d11482775336"),
}


def hash_of(gaussians: Gaussians) -> str:
    digest = hashlib.sha256()
    for column in fields(gaussians):
        digest.update(np.ascontiguousarray(getattr(gaussians, column.name)).tobytes())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("name", sorted(DECODED))
def test_results_are_those_of_then(name: str, tmp_path: Path) -> None:
    state = load_state(FOLDER / f"{name}.gsm")
    assert tuple(hash_of(decoded(state, k=k)) for k in (1, 2)) == DECODED[name]
    save_state(tmp_path / "new.gsm", state)
    same_state(load_state(tmp_path / "new.gsm"), state)


def test_what_each_holds() -> None:
    encoded, state, latents = (load_state(FOLDER / f"{name}.gsm") for name in ("encoded", "state", "latents"))
    assert isinstance(encoded.groups, DividedGroups)
    assert isinstance(state.groups, GroupSet)
    assert isinstance(latents.groups, GroupSet)
    assert (len(encoded.replay), len(state.replay), len(latents.replay)) == (0, 4, 1)
    assert (encoded.networks, state.networks) == (None, None)
    assert latents.networks is not None
    assert encoded.about["source"]["name"] == "room.ply"
    assert not {"fit", "device"} & encoded.about["options"].keys()  # there is nothing to fit to, and other machines
    assert [len(one.about["batches"]) for one in (encoded, state, latents)] == [1, 2, 2]


@pytest.mark.parametrize("name", sorted(DECODED))
def test_views_are_added(name: str) -> None:
    compactor = Compactor.load(
        FOLDER / f"{name}.gsm", checkpoint="networks.safetensors" if name == "latents" else "none"
    )
    before, num_batches = len(compactor), len(compactor.batches)
    report = compactor.extend(parts_of(room(6, 18, 12), 2)[2])
    assert report.num_joined + report.num_covered > 0
    assert len(compactor) >= before
    assert len(compactor.batches) == num_batches + 1
    assert isinstance(compactor.state.groups, GroupSet)


@pytest.mark.parametrize("name", sorted(DECODED))
def test_they_are_compacted_and_checked(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    assert main(["compact", str(FOLDER / f"{name}.gsm"), "--k", "2", "--fit", "none", "-o", str(out), "-q"]) == 0
    assert (b"SplatRenderMode: mip" in out.read_bytes()) == (name == "encoded")
    assert main(["inspect", str(FOLDER / f"{name}.gsm"), "-q"]) == 0
