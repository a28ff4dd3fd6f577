"""The file of one batch, with networks: what comes back, what is ignored, and every kind of damage."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scenes
from hostile.gsm_files import (
    GSM_HEADERS,
    Spoil,
    assert_refused_in_one_line,
    filled,
    header,
    of_arrays,
    with_array,
    with_header,
    with_settings,
)
from network_fixtures import noisy, written
from safetensors.numpy import load_file, save_file
from view_batches import decoded, one_batch, same_state

from gsmerge.errors import SceneError
from gsmerge.states.gsm_file import STATE
from gsmerge.states.state import DividedGroups, State
from gsmerge.states.state_file import load_state, save_state


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> State:
    checkpoint = written(tmp_path_factory.mktemp("networks") / "a.safetensors", noisy())
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 24, 18), degree=1)
    state = one_batch(scene, superpixels=60, checkpoint=str(checkpoint))
    assert isinstance(state.groups, DividedGroups)
    assert state.networks is not None
    return state


@pytest.fixture
def path(state: State, tmp_path: Path) -> Path:
    save_state(tmp_path / "scene.gsm", state)
    return tmp_path / "scene.gsm"


ARRAYS = ("division.splits", "division.means", "heads.views", "heads.group", "networks.heads.1.out.weight")
DAMAGED: dict[str, Spoil] = {
    "no networks": with_header(networks={"width": -1}),
    "networks of another size": with_header(networks={"width": 32, "heads": 2, "latent": 4}),
    "a negative number": with_settings(target_count=-1),
    "a knee of words": with_settings(knee_count="knee"),
    "slots beyond the children": with_array("division.slots", lambda a: a + 8),
    "more splits than slots": with_array("division.splits", lambda a: a + 1),
    "fewer slots": with_array("division.slots", lambda a: a[1:]),
    "deals to nobody": with_array("division.growth_order", filled(10_000_000)),
    "deals to one": with_array("division.growth_order", np.zeros_like),
    "negative deals": with_array("division.growth_order", filled(-1)),
    "wholes beyond": with_array("division.uniform", lambda _: np.full(1, 10_000_000, np.int32)),
    "wholes that are split": with_array("division.uniform", lambda _: np.zeros(1, np.int32)),
    "views beyond": with_array("heads.views", filled(3)),
    "saliency of others": with_array("features.saliency", lambda a: a[1:]),
    "saliency of nothing": with_array("features.saliency", filled(np.nan)),
    **of_arrays(ARRAYS, ("division.means", "heads.group")),
}


def test_everything_comes_back(path: Path, state: State, tmp_path: Path) -> None:
    actual = load_state(path)
    same_state(actual, state)
    assert actual.about == json.loads(json.dumps(state.about))
    assert scenes.identical(decoded(actual, k=2), decoded(state, k=2))
    save_state(tmp_path / "loaded.gsm", actual)
    assert (tmp_path / "loaded.gsm").read_bytes() == path.read_bytes()


def test_what_is_not_known_is_not_looked_at(path: Path, state: State) -> None:
    said, arrays = header(path), load_file(path)
    arrays["features.moods"], arrays["state.views"] = np.full(7, np.nan), np.zeros(3)
    said |= {"minor": 7, "moods": ["good"], "precision": "bfloat16"}  # 0.1 wrote a precision
    said["settings"]["mood"] = "better"
    save_file(arrays, path, {STATE: json.dumps(said), "mood": "best"})
    assert scenes.identical(decoded(load_state(path)), decoded(state))


@pytest.mark.parametrize("damage", sorted(DAMAGED))
def test_damage_is_told_in_one_line(damage: str, path: Path) -> None:
    DAMAGED[damage](path)
    assert_refused_in_one_line(load_state, path)


def test_a_newer_schema_says_what_to_do(path: Path) -> None:
    GSM_HEADERS["a newer schema"](path)
    with pytest.raises(
        SceneError, match=r"expected schema 1 to 2, found 3; written by gsmerge 9\.9; this is .*, update it"
    ):
        load_state(path)


def test_an_existing_file_is_kept(path: Path, state: State) -> None:
    before = path.read_bytes()
    with pytest.raises(SceneError, match="exists"):
        save_state(path, state)
    save_state(path, state, overwrite=True)
    assert path.read_bytes() == before
