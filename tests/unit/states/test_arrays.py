"""Feature Gaussians as arrays: in the world, as the page says, and as what is decoded of them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from network_fixtures import SMALL, noisy, written
from view_batches import decoded, fed, parts_of, room, state_of

from gsmerge import Scene
from gsmerge.geometry import covariances
from gsmerge.kernels import elementary
from gsmerge.states.arrays import convert_state, feature_arrays
from gsmerge.states.state import State
from gsmerge.states.state_file import save_state

EVERY = {"min_opacity": 0.0, "min_contribution": 0.0}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """In a world of its own unit, far from the origin."""
    return scenes.move(room(4), np.eye(3), 5.0, np.array([100.0, -20.0, 3.0]))


@pytest.fixture(scope="module")
def plain(scene: Scene) -> State:
    return state_of(fed([scene], **EVERY))


@pytest.fixture(scope="module", params=[4, 2])
def learned(request: pytest.FixtureRequest, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> State:
    """With latents, of one batch and of two."""
    path = written(tmp_path_factory.mktemp("networks") / "a.safetensors", noisy(replace(SMALL, outputs="absolute")))
    return state_of(fed(parts_of(scene, request.param), **EVERY, match="aabb", tolerance=0, checkpoint=str(path)))


def test_they_are_what_is_decoded(plain: State) -> None:
    arrays, one = feature_arrays(plain), decoded(plain, k=1)
    assert plain.frame.unit > 1
    for name, column in vars(one).items():
        np.testing.assert_array_equal(arrays[name], column, name)
    expected = covariances(one.quats.astype(np.float64), one.scales.astype(np.float64))
    np.testing.assert_allclose(arrays["covars"], expected, rtol=1e-4, atol=1e-5 * expected.max())
    discs = one.scales[:, 1].astype(np.float64) * one.scales[:, 2]
    depths = np.minimum(1 - elementary.exp(-arrays["gains"] * arrays["extinctions"] / discs), arrays["opacities"].max())
    np.testing.assert_allclose(depths, arrays["opacities"], rtol=1e-4)


def test_members_add_up_in_the_world(plain: State, learned: State, scene: Scene) -> None:
    given = scene.gaussians
    volumes = (2 * np.pi) ** 1.5 * given.opacities.astype(np.float64) * given.scales.astype(np.float64).prod(1)
    for state, sums in ((plain, feature_arrays(plain)), (learned, feature_arrays(learned))):
        assert sums["weights"].sum() == pytest.approx(given.opacities.sum(), rel=1e-4)
        assert len(sums["means"]) == len(state)
    assert feature_arrays(plain)["masses"].sum() == pytest.approx(volumes.sum(), rel=1e-4)
    arrays = feature_arrays(learned)
    assert arrays["num_members"].sum() == scene.num_gaussians
    assert arrays["latents"].shape == (len(learned), SMALL.latent)
    assert 0 <= arrays["views"].min() < arrays["views"].max() == 3
    np.testing.assert_allclose(arrays["viewmats"], scene.cameras.viewmats, atol=1e-4)
    np.testing.assert_array_equal(arrays["Ks"], scene.cameras.Ks)
    assert arrays["size"].tolist() == [36, 24]


def test_the_page_names_all_with_shape_and_type(plain: State, learned: State, root: Path) -> None:
    page = (root / "docs" / "reference" / "formats.md").read_text()
    listed = page.partition("\n## Feature Gaussians")[2].partition("\n## ")[0]
    said = dict[str, tuple[str, str]]()
    for entry in re.findall(r"^- (`.*?): ", listed, re.MULTILINE):
        shapes = re.findall(r"`\[(.*?)\]`", entry)
        found = re.findall(r"`(\w+)`", entry)
        said |= {name: (shape, entry.split()[-1]) for name, shape in zip(found, shapes, strict=True)}
    both = [feature_arrays(state) for state in (plain, learned)]
    assert {name for arrays in both for name in arrays} == set(said)
    for arrays in both:
        sizes = {"g": len(arrays["means"]), "v": 4, "h": 0, "d": arrays["latents"].shape[1]}
        for name, array in arrays.items():
            shape, kind = said[name]
            assert array.shape == tuple(sizes[side] if side in sizes else int(side) for side in shape.split(",")), name
            assert array.dtype == kind, name


def test_a_file_is_read_back(learned: State, tmp_path: Path) -> None:
    save_state(tmp_path / "a.gsm", learned)
    document = convert_state(tmp_path / "a.gsm", tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        arrays = dict(file)
    expected = feature_arrays(learned)
    assert arrays.keys() == expected.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, expected[name], name)
        assert document["output"]["arrays"][name] == list(array.shape)
    convert_state(tmp_path / "a.gsm", tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
