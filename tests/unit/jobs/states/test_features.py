"""Feature Gaussians are encoded once, decoded at any K, matched and merged across batches (paper section 4.5)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from network_fixtures import SMALL, noisy, written

from gsmerge import Compactor, Scene, compact
from gsmerge.errors import UsageError
from gsmerge.jobs.states.features import FeatureState
from gsmerge.method.geometry.transforms import camera_centres

PAPER: dict[str, Any] = {"recipe": "paper", "superpixels": "10%"}


def make_room() -> Scene:
    """Return four views of 36 x 24."""
    return scenes.make_scene(scenes.room(), scenes.arc(4, 36, 24), noise=0.005)


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room()


def fed(*batches: Scene, **wish: Any) -> Compactor:
    compactor = Compactor(**{**PAPER, **wish})
    for batch in batches:
        compactor.extend(batch)
    return compactor


def halves(scene: Scene) -> list[Scene]:
    return [scenes.take_views(scene, views) for views in ((0, 1), (2, 3))]


def state_of(compactor: Compactor) -> FeatureState:
    features = compactor.state.features
    assert features is not None
    return features


def saved(compactor: Compactor, path: Path) -> Compactor:
    compactor.save(path, overwrite=True)
    return Compactor.load(path, **PAPER)


@pytest.fixture(scope="module")
def whole() -> Compactor:
    return fed(make_room())


@pytest.mark.parametrize("k", [1, 2, 4, "mixed"])
def test_one_batch_is_decoded_as_compact_decodes_it(
    k: int | str, room: Scene, whole: Compactor, tmp_path: Path
) -> None:
    """To the last bit, from memory and from its file."""
    wish = {"k": k, "poses": "fixed", "exposure": "fixed"}
    expected = compact(room, **PAPER, **wish).gaussians
    mixed = {"k_low": 100 / 3, "k_high": 200 / 3} if k == "mixed" else {}  # as the recipe has it
    for compactor in (whole, saved(whole, tmp_path / "room.gsm")):
        assert scenes.identical(compactor.decode(k=k, **mixed), expected)


def test_a_shape_that_was_seen_becomes_part_of_what_is_there(room: Scene, tmp_path: Path) -> None:
    first, second = halves(room)
    begun = fed(first)
    alone, other = len(begun), len(fed(second))
    one = saved(begun, tmp_path / "one.gsm")
    report = one.extend(second)
    assert max(alone, other) < len(one) < alone + other
    assert report.num_gaussians == len(one)
    assert len(state_of(one).cameras) == 4
    np.testing.assert_allclose(
        camera_centres(state_of(one).frame.leave_cameras(state_of(one).cameras).viewmats),
        camera_centres(room.cameras.viewmats),
        atol=1e-5,
    )
    assert scenes.identical(one.decode(k=2), fed(first, second).decode(k=2))


def test_batches_show_the_views_as_all_at_once_do(room: Scene, whole: Compactor) -> None:
    batched = fed(*halves(room))
    psnrs = [scenes.psnr_of(compactor.decode(k=4), room) for compactor in (whole, batched)]
    assert psnrs[1] > psnrs[0] - 1.5


def test_same_views_again_add_few_features(room: Scene, whole: Compactor) -> None:
    twice = fed(room, room)
    assert len(whole) <= len(twice) <= 1.35 * len(whole)


def test_cameras_of_another_size_are_scaled_to_the_first_batch(room: Scene) -> None:
    small = scenes.make_scene(scenes.room(), scenes.arc(2, 24, 16), noise=0.005)
    cameras = state_of(fed(room, small)).cameras
    assert (len(cameras), cameras.width, cameras.height) == (6, 36, 24)
    np.testing.assert_allclose(cameras.Ks[4:, :2], 1.5 * small.cameras.Ks[:, :2], rtol=1e-6)


def test_state_goes_on_with_its_networks_without_their_file(room: Scene, tmp_path: Path) -> None:
    options = replace(SMALL, outputs="absolute")
    path = written(tmp_path / "a.safetensors", noisy(options))
    compactor = saved(fed(halves(room)[0], checkpoint=str(path)), tmp_path / "a.gsm")
    path.unlink()
    with pytest.raises(UsageError, match="expected the networks that made the state"):
        compactor.extend(halves(room)[1])
    compactor._settings = {**PAPER, "checkpoint": str(path)}
    compactor.extend(halves(room)[1])
    assert len(compactor.decode(k=1)) > 0


@pytest.mark.parametrize(
    ("wish", "match"),
    [
        ({"budget": 100}, "budget"), ({"fit": "full"}, "fit full"), ({"drop": "sky"}, "drop sky"),
        ({"checkpoint": "shipped"}, "absolute"),
    ],
)  # fmt: skip
def test_settings_that_feature_gaussians_cannot_follow_are_refused(
    wish: dict[str, Any], match: str, room: Scene
) -> None:
    with pytest.raises(ValueError, match=match):
        fed(room, **wish)


def test_decoding_beyond_the_paper_s_heads_is_refused(room: Scene, whole: Compactor) -> None:
    for wish, match in (({"k": 8}, "1 to 4"), ({"k": "mixed", "k_rule": "distortion"}, "saliency")):
        with pytest.raises(ValueError, match=match):
            whole.decode(**wish)
    with pytest.raises(ValueError, match="decode"):
        whole.compact(budget=10)
    rich = scenes.make_scene(scenes.room(), scenes.arc(2, 24, 18), degree=1)
    with pytest.raises(UsageError, match="degree 0"):
        fed(halves(room)[0], rich)
