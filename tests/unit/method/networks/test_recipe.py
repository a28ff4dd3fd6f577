"""``recipe="paper"`` is the paper's own chain under one name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import refuses
from network_fixtures import noisy, untrained, written
from unaligned_scenes import shuffled

from gsmerge import Scene, compact
from gsmerge.errors import UsageError
from gsmerge.method.networks.options import NetworkOptions
from gsmerge.method.stages.assign import find_owners
from gsmerge.method.stages.superpixels import segment
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import SegmentOptions

SMALL = NetworkOptions(
    width=16, heads=2, latent=8, members=4, neighbors=4, outputs="absolute", merger_start="first", geometry="carried",
    group_numbers=False,
)  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


@pytest.fixture(scope="module")
def absolute(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return networks that moved away from their start at random."""
    return written(tmp_path_factory.mktemp("networks") / "absolute.safetensors", noisy(SMALL, 0.05))


def test_recipe_means_the_settings_of_its_table(scene: Scene, absolute: Path) -> None:
    actual = compact(scene, recipe="paper", checkpoint=str(absolute))
    settings = {"segmentation": "bass-st", "superpixels": "5.3%", "match": "aabb", "fit": "none", "min_contribution": 0}
    expected = compact(scene, **settings, checkpoint=str(absolute))
    assert np.array_equal(actual.gaussians.means, expected.gaussians.means)
    assert actual.report.options["recipe"] == "paper"
    assert actual.report.choices["networks"]["options"]["outputs"] == "absolute"
    assert {"encode", "match", "refine", "decode"} <= set(actual.report.seconds)
    assert actual.report.options["fit"] == "none"


def test_other_settings_go_before_those_of_a_recipe() -> None:
    options = CompactOptions().with_settings({"recipe": "paper", "checkpoint": "a.safetensors", "match": "none"})
    assert options.match.match == "none"
    assert options.segment.segmentation == "bass-st"
    assert options.with_settings({"k": 2}).match.match == "none"


@pytest.mark.parametrize("k", [1, 3])
def test_every_group_has_k_children(scene: Scene, absolute: Path, k: int) -> None:
    """Also groups of fewer members, and nothing is left out but by opacity."""
    result = scenes.compacted(scene, recipe="paper", checkpoint=str(absolute), k=k, superpixels="20%", min_opacity=0.0)
    assert len(result.gaussians) == k * result.report.choices["clusters"]


def test_gaussians_without_pixels_go_to_superpixels_by_blending_weight(absolute: Path) -> None:
    """All of them in one superpixel are one group; those that no view draws are left out."""
    scene = shuffled(scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01))
    groups = segment(scene.images, SegmentOptions(superpixels=40, segmentation="bass-st"))
    owners = find_owners(scene, groups)
    assert (owners.labels < 0).any()  # negligible: drawn nowhere
    result = compact(scene, recipe="paper", checkpoint=str(absolute), superpixels=40, match="none", min_opacity=0.0)
    filled = np.unique(np.stack([owners.views, owners.labels])[:, owners.labels >= 0], axis=1).shape[1]
    assert len(result.gaussians) == filled


@pytest.mark.parametrize("checkpoint", ["auto", "none"])
def test_recipe_without_networks_is_refused(checkpoint: str) -> None:
    with refuses(ValueError, "recipe paper", "absolute", checkpoint):
        CompactOptions().with_settings({"recipe": "paper", "checkpoint": checkpoint})


def test_recipe_refuses_residual_networks(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "residual.safetensors"
    written(path, untrained(replace(SMALL, outputs="residual")))
    for checkpoint in (str(path), "shipped"):
        with refuses(UsageError, "recipe paper", "absolute", "residual"):
            scenes.compacted(scene, recipe="paper", checkpoint=checkpoint)


def test_networks_with_absolute_outputs_ship(scene: Scene) -> None:
    networks = scenes.compacted(scene, recipe="paper").report.choices["networks"]
    assert networks["checkpoint"] == "paper"
    assert networks["options"]["outputs"] == "absolute"


def test_more_children_than_a_head_has_are_refused(scene: Scene, absolute: Path) -> None:
    with refuses(UsageError, "k", 4, 5):
        scenes.compacted(scene, recipe="paper", checkpoint=str(absolute), k=5)
