"""The file of several batches: what comes back, and every kind of damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hostile.gsm_files import (
    GSM_HEADERS,
    UNREADABLE,
    WILD_NUMBERS,
    Spoil,
    assert_refused_in_one_line,
    damaged,
    filled,
    of_arrays,
    with_about,
    with_array,
    with_header,
    with_settings,
    with_text,
)
from unaligned_scenes import far_behind, shuffled
from view_batches import fed, parts_of, room, same_state, state_of

from gsmerge import Compactor, Gaussians
from gsmerge.states.state import State
from gsmerge.states.state_file import load_state, save_state


@pytest.fixture(scope="module")
def state() -> State:
    return state_of(fed(parts_of(room(4, degree=1), 2)))


@pytest.fixture
def path(state: State, tmp_path: Path) -> Path:
    save_state(tmp_path / "state.gsm", state)
    return tmp_path / "state.gsm"


ARRAYS = (
    *("features.means", "features.latents", "features.views", "features.fitted_sh0", "features.color_precision"),
    *("children.quats", "children.shN", "children.counts", "kept.means", "cameras.viewmats", "cameras.Ks"),
    *("frame.origin", "replay.images", "replay.views"),
)
FLOATS = ("features.fitted_sh0", "features.color_precision", "children.quats", "cameras.viewmats", "cameras.Ks")
DAMAGED: dict[str, Spoil] = {
    **UNREADABLE,
    **GSM_HEADERS,
    "of 0.1's encode by its name": with_text("{}", "gsmerge-encoded"),
    "views of another size": with_header(width=35),
    "about without options": with_header(about={"batches": []}),
    "batches by number": with_header(about={"options": {}, "batches": {"0": 1}}),
    "a checkpoint in a list": with_about(options={"checkpoint": ["x"]}),
    "neighbours without end": with_about(options={"neighbors": 10**9}),
    "latents without networks": with_array("features.latents", lambda a: np.zeros((len(a), 4), np.float32)),
    "most of fewer than there are": with_settings(max_k=1),
    "a negative number": with_settings(num_input=-1),
    "a group without children": with_array("children.counts", filled(0)),
    "a group with too many": with_array("children.counts", filled(9)),
    "children of nobody": with_array("children.counts", lambda a: a.clip(max=1)),
    "harmonics of another degree": with_array("children.shN", lambda a: a[:, :0]),
    "views beyond": with_array("replay.views", lambda a: a + 3),
    "views in no order": with_array("replay.views", lambda a: a[::-1]),
    "photos of another size": with_array("replay.images", lambda a: a[:, 1:]),
    **of_arrays(ARRAYS, FLOATS),
    **WILD_NUMBERS,
}


def test_everything_comes_back(path: Path, state: State) -> None:
    same_state(load_state(path), state)


def test_the_same_state_gives_the_same_bytes(path: Path, state: State, tmp_path: Path) -> None:
    save_state(tmp_path / "again.gsm", state)
    save_state(tmp_path / "loaded.gsm", load_state(path))
    assert (tmp_path / "again.gsm").read_bytes() == path.read_bytes()
    assert (tmp_path / "loaded.gsm").read_bytes() == path.read_bytes()


def test_saved_between_batches_is_kept_in_memory(tmp_path: Path) -> None:
    """Bit for bit, in everything."""
    batches, settings = parts_of(room(6), 2), {"max_k": 2, "replay": 2}
    kept = fed(batches, **settings)
    stored = fed(batches[:1], **settings)
    for number, batch in enumerate(batches[1:]):
        stored.save(tmp_path / f"{number}.gsm")
        stored = Compactor.load(tmp_path / f"{number}.gsm")
        stored.extend(batch)
    same_state(state_of(stored), state_of(kept))
    assert stored.batches == kept.batches


def test_what_no_view_sees_comes_back(tmp_path: Path) -> None:
    unaligned = shuffled(room(2))
    both = replace(unaligned, gaussians=Gaussians.concat([unaligned.gaussians, far_behind(unaligned.gaussians, 200)]))
    state = state_of(fed([both], unseen="keep", fit="none"))
    save_state(tmp_path / "a.gsm", state)
    same_state(load_state(tmp_path / "a.gsm"), state)


@pytest.mark.parametrize("damage", sorted(DAMAGED))
def test_damage_is_told_in_one_line(damage: str, path: Path) -> None:
    DAMAGED[damage](path)
    assert_refused_in_one_line(load_state, path)


def test_what_is_not_what_was_written_is_refused(path: Path) -> None:
    """As finite as the numbers are: only the checksum tells."""
    damaged("children.sh0")(path)
    assert "checksums" in assert_refused_in_one_line(load_state, path).partition("children.sh0")[2]


def test_a_file_decides_nothing_of_the_machine(path: Path, tmp_path: Path) -> None:
    said = {
        "threads": 3000,
        "device": "cuda",
        "checkpoint": str(tmp_path / "x.safetensors"),
        "seed": 4,
        "of later": [1],
    }
    with_about(options=said)(path)
    assert load_state(path).about["options"] == {"seed": 4}
