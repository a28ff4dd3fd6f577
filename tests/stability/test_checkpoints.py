"""Networks that are missing, damaged or badly wrong do little harm, or are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from network_fixtures import noisy, scaled, untrained, written
from safetensors.numpy import load_file, save_file
from scenes import arc, assert_invariants, identical, make_scene, room
from sweeps import sweep
from unaligned_scenes import shuffled

import gsmerge
from gsmerge.method.kernels import elementary
from gsmerge.method.networks.checkpoint import IN_PACKAGE
from gsmerge.method.networks.options import Bounds
from gsmerge.types import SH_C0

PLAIN = {"fit": "none", "match": "none", "superpixels": 100, "poses": "fixed"}


@sweep(
    "settings",
    [
        {},
        {"k": 2},
        {"k": 4},
        {"match": "aabb", "similarity": -1.0, "max_color": 2.0},
        {"fit": "full", "fit_steps": 4},
        {"budget": 150},
    ],
)
def test_untrained_networks_are_the_analytic_pipeline(tmp_path: Path, settings: dict[str, object]) -> None:
    scene = make_scene(room(), arc(2, 32, 24))
    path = written(tmp_path / "a.safetensors", untrained())
    chosen = {"superpixels": 80, "fit": "none", "poses": "fixed", **settings}
    plain, networks = (
        gsmerge.compact(scene, **chosen, checkpoint="none"),
        gsmerge.compact(scene, **chosen, checkpoint=str(path)),
    )
    assert identical(plain.gaussians, networks.gaussians)
    assert networks.report.choices["networks"]["checkpoint"] == str(path)
    assert "networks" not in plain.report.choices
    assert "refine" in networks.report.seconds


def compact_shuffled(path: Path, **settings: object) -> gsmerge.Gaussians:
    """Compact a scene whose rows are in no order."""
    scene = shuffled(make_scene(room(), arc(3, 32, 24)))
    chosen = {"fit": "none", "superpixels": "10%", "poses": "fixed", "checkpoint": str(path)}
    return gsmerge.compact(scene, **chosen, **settings).gaussians


def test_networks_change_scenes_in_no_order(tmp_path: Path) -> None:
    path = written(tmp_path / "a.safetensors", untrained())
    plain = compact_shuffled(path)  # which assigns rows by their centres
    changed = compact_shuffled(written(path, noisy()))
    assert_invariants(changed, make_scene(room(), arc(3, 32, 24)))
    assert not np.array_equal(changed.means[:20], plain.means[:20])


def test_networks_give_scenes_in_no_order_the_same_bits_on_any_number_of_threads(tmp_path: Path) -> None:
    path = written(tmp_path / "a.safetensors", noisy())
    assert identical(compact_shuffled(path, threads=1), compact_shuffled(path, threads=3))


@sweep("settings", [{"levels": 2}, {}, {"quality": "15dB"}])
def test_every_result_says_which_networks_it_is_from(tmp_path: Path, settings: dict[str, object]) -> None:
    scene = make_scene(room(), arc(2))
    path = written(tmp_path / "a.safetensors", noisy())
    actual = gsmerge.compact(scene, fit="none", superpixels="10%", checkpoint=str(path), **settings)
    for result in (actual, *actual.coarser):
        assert result.report.choices["networks"]["checkpoint"] == str(path)
    rival = gsmerge.compact(scene, method="random", checkpoint=str(path))
    assert "networks" not in rival.report.choices
    assert any("checkpoint" in note for note in rival.report.notes)


@pytest.mark.parametrize("damage", ["missing", "cut off"])
def test_networks_of_the_package_that_cannot_be_used_are_noted(
    tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(room(), arc(2))
    path = tmp_path / "a.safetensors"
    plain = gsmerge.compact(scene, **PLAIN, checkpoint="none")
    if damage == "cut off":
        path.write_bytes(written(path, noisy()).read_bytes()[:-100])
    monkeypatch.setitem(IN_PACKAGE, "shipped", path)
    fallen = gsmerge.compact(scene, **PLAIN, checkpoint="shipped")
    assert identical(plain.gaussians, fallen.gaussians)
    assert [note for note in fallen.report.notes if str(path) in note]
    assert "networks" not in fallen.report.choices


@sweep("options", [{}, {"method": "random", "budget": 40}])
def test_named_checkpoint_must_be_usable(tmp_path: Path, options: dict[str, object]) -> None:
    with pytest.raises(gsmerge.SceneError, match="nosuch: expected a checkpoint, found no such file"):
        gsmerge.compact(make_scene(room(), arc(2)), **PLAIN | options, checkpoint=str(tmp_path / "nosuch"))


def test_a_required_checkpoint_that_is_missing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(gsmerge.SceneError, match=r"a\.safetensors"):
        compact_shuffled(tmp_path / "a.safetensors", require_checkpoint=True)


def test_no_checkpoint_and_a_required_one_contradict() -> None:
    with pytest.raises(ValueError, match="require_checkpoint"):
        compact_shuffled(Path("none"), require_checkpoint=True)


def test_a_required_checkpoint_with_nan_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.safetensors", noisy())
    arrays = load_file(path)
    arrays["encoder.latent.bias"][0] = float("nan")
    save_file(arrays, path)
    with pytest.raises(gsmerge.SceneError):
        compact_shuffled(path, require_checkpoint=True)


@sweep("k", [1, 2, 4], often=2, ids="k={}".format)
def test_weights_a_hundred_times_as_large_stay_within_the_bounds(tmp_path: Path, k: int) -> None:
    scene = make_scene(room(), arc(2))
    path = written(tmp_path / "a.safetensors", scaled(noisy(), 100))
    before = gsmerge.compact(scene, **PLAIN, k=k, min_opacity=0.0, min_contribution=0.0, checkpoint="none")
    after = gsmerge.compact(scene, **PLAIN, k=k, min_opacity=0.0, min_contribution=0.0, checkpoint=str(path))
    assert_invariants(after.gaussians, scene)
    a, b, bounds = before.gaussians, after.gaussians, Bounds()
    assert len(a) == len(b)
    stages = 1.5 if k == 1 else 1.0  # refiner and head; children are pooled anew, so the refiner does not reach them
    assert np.abs(np.log(b.scales) - np.log(a.scales)).max() <= stages * bounds.size * 1.001
    assert np.abs(SH_C0 * (b.sh0 - a.sh0)).max() <= stages * bounds.color * 1.001
    largest = a.scales.max(1) * (2 + stages * elementary.exp(bounds.size))  # encoder, refiner, head
    assert (np.linalg.norm(b.means - a.means, axis=1) <= 3**0.5 * 2 * largest).all()
    assert np.abs(b.means - a.means).max() > 0
