"""The file: what comes back, what is ignored, and every kind of damage."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from hostile.gsm_files import (
    GSM_HEADERS,
    UNREADABLE,
    WILD_NUMBERS,
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

from gsmerge import Encoded, decode_scene, encode_scene, load_encoded, save_encoded
from gsmerge.errors import SceneError
from gsmerge.states.gsm_file import ENCODED


@pytest.fixture(scope="module")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> Encoded:
    checkpoint = written(tmp_path_factory.mktemp("networks") / "a.safetensors", noisy())
    scene = scenes.make_scene(scenes.room(), scenes.arc(3), degree=1)
    return encode_scene(scene, superpixels=60, checkpoint=str(checkpoint), fit="none")


@pytest.fixture
def path(encoded: Encoded, tmp_path: Path) -> Path:
    save_encoded(tmp_path / "scene.gsm", encoded)
    return tmp_path / "scene.gsm"


ARRAYS = (
    *(f"features.{name}" for name in ("means", "covars", "masses", "latents", "views", "sh0", "shN")),
    *(
        "division.splits",
        "division.slots",
        "division.uniform",
        "division.growth_order",
        "division.quats",
        "division.shN",
    ),
    *("kept.means", "cameras.viewmats", "cameras.Ks", "frame.origin", "heads.views", "heads.group"),
    "networks.heads.1.out.weight",
)
DAMAGED: dict[str, Spoil] = {
    **UNREADABLE,
    **GSM_HEADERS,
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
    **of_arrays(ARRAYS, ("features.covars", "division.means", "cameras.Ks", "frame.origin", "heads.group")),
    **WILD_NUMBERS,
}


def test_everything_comes_back(path: Path, encoded: Encoded) -> None:
    actual = load_encoded(path)
    assert actual.settings == encoded.settings
    assert actual.frame.unit == encoded.frame.unit
    assert actual.about == json.loads(json.dumps(encoded.about))
    assert len(actual) == len(encoded)
    assert actual.heads is not None
    for name, column in vars(encoded.features).items():
        np.testing.assert_array_equal(getattr(actual.features, name), column, name)
    for k in (1, 2, 4):
        assert scenes.identical(decode_scene(actual, k=k), decode_scene(encoded, k=k))


def test_what_no_view_sees_comes_back(encoded: Encoded, tmp_path: Path) -> None:
    kept = replace(encoded, kept=encoded.division.children[:5])
    save_encoded(tmp_path / "kept.gsm", kept)
    actual = load_encoded(tmp_path / "kept.gsm")
    assert actual.num_kept == 5
    assert scenes.identical(decode_scene(actual), decode_scene(kept))


def test_the_same_scene_gives_the_same_bytes(path: Path, encoded: Encoded, tmp_path: Path) -> None:
    save_encoded(tmp_path / "again.gsm", encoded)
    assert (tmp_path / "again.gsm").read_bytes() == path.read_bytes()
    save_encoded(tmp_path / "loaded.gsm", load_encoded(path))
    assert (tmp_path / "loaded.gsm").read_bytes() == path.read_bytes()


def test_the_source_is_told(encoded: Encoded, tmp_path: Path) -> None:
    save_encoded(tmp_path / "scene.gsm", encoded, source={"name": "scene.ply", "bytes": 5})
    assert load_encoded(tmp_path / "scene.gsm").about["source"] == {"name": "scene.ply", "bytes": 5}


def test_what_is_not_known_is_not_looked_at(path: Path, encoded: Encoded) -> None:
    said, arrays = header(path), load_file(path)
    arrays["features.moods"], arrays["state.views"] = np.full(7, np.nan), np.zeros(3)
    said |= {"minor": 7, "moods": ["good"], "precision": "bfloat16"}  # older versions wrote a precision
    said["settings"]["mood"] = "better"
    save_file(arrays, path, {ENCODED: json.dumps(said), "mood": "best"})
    assert scenes.identical(decode_scene(load_encoded(path)), decode_scene(encoded))


@pytest.mark.parametrize("damage", sorted(DAMAGED))
def test_damage_is_told_in_one_line(damage: str, path: Path) -> None:
    DAMAGED[damage](path)
    assert_refused_in_one_line(load_encoded, path)


def test_a_newer_schema_says_what_to_do(path: Path) -> None:
    DAMAGED["a newer schema"](path)
    with pytest.raises(SceneError, match=r"expected schema 1, found 2; written by gsmerge 9\.9; this is .*, update it"):
        load_encoded(path)


def test_an_existing_file_is_kept(path: Path, encoded: Encoded) -> None:
    before = path.read_bytes()
    with pytest.raises(SceneError, match="exists"):
        save_encoded(path, encoded)
    save_encoded(path, encoded, overwrite=True)
    assert path.read_bytes() == before
