"""The networks that come with the package: they gain where nothing is fitted, and a file without knowledge does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import gsmerge
from gsmerge.networks.checkpoint import SHIPPED, load_checkpoint, save_checkpoint

LEAST_GAIN = 1.0  # dB on photos that the scene was not made from


@pytest.fixture(scope="module")
def gain(
    make_scene: Callable[..., Path],
    target_psnr: Callable[[Path, Path], float],
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[Path], float]:
    """dB that networks add to the analytic stages, on a synthetic scene that nobody trained on."""
    folder = tmp_path_factory.mktemp("gain")
    made = make_scene(folder / "scene", num_views=4, width=128, height=96, seed=123)
    scene = gsmerge.read_scene(made)

    def psnr(checkpoint: str) -> float:
        result = gsmerge.compact(scene, fit="none", checkpoint=checkpoint)
        gsmerge.write_ply(folder / "small.ply", result.gaussians, overwrite=True)
        return target_psnr(made / "targets", folder / "small.ply")

    analytic = psnr("none")
    return lambda path: psnr(str(path)) - analytic


def test_shipped_networks_gain(gain: Callable[[Path], float]) -> None:
    assert gain(SHIPPED) > LEAST_GAIN


def test_the_papers_method_beats_its_moment_matching(
    make_scene: Callable[..., Path], target_psnr: Callable[[Path, Path], float], tmp_path: Path
) -> None:
    """With the networks of absolute outputs that ship, on a scene that nobody trained on."""
    made = make_scene(tmp_path / "scene", num_views=4, width=192, height=144, seed=123)
    scene, psnr = gsmerge.read_scene(made), {}
    for name, settings in {"networks": {"recipe": "paper"}, "moments": {"method": "moment-matching"}}.items():
        gsmerge.write_ply(tmp_path / "small.ply", gsmerge.compact(scene, **settings).gaussians, overwrite=True)
        psnr[name] = target_psnr(made / "targets", tmp_path / "small.ply")
    assert psnr["networks"] > psnr["moments"] + LEAST_GAIN


def test_networks_of_zeros_gain_nothing(gain: Callable[[Path], float], tmp_path: Path) -> None:
    """The same file with every weight zero is a checkpoint like any other, and fails the test above."""
    networks = load_checkpoint(SHIPPED).networks
    for tensor in networks.state_dict().values():
        tensor.zero_()
    save_checkpoint(tmp_path / "zeros.safetensors", networks, {})
    assert abs(gain(tmp_path / "zeros.safetensors")) < LEAST_GAIN / 2


def test_networks_of_noise_gain_nothing(gain: Callable[[Path], float], tmp_path: Path) -> None:
    networks = load_checkpoint(SHIPPED).networks
    torch.manual_seed(0)
    for tensor in networks.state_dict().values():
        tensor.copy_(torch.randn_like(tensor) * tensor.std())
    save_checkpoint(tmp_path / "noise.safetensors", networks, {})
    assert gain(tmp_path / "noise.safetensors") < LEAST_GAIN
