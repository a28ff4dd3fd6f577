"""No function mixes the device with the CPU: everything once more on a second device that refuses it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from other_device import DEVICE, Elsewhere, SecondDevice
from torch.utils._pytree import tree_flatten, tree_map

from gsmerge import CompactOptions
from gsmerge.gpu import full, raster
from gsmerge.gpu.build import DeviceScene
from gsmerge.gpu.scene import DevicePhotos, upload_gaussians, upload_photos
from gsmerge.pipeline import begin
from gsmerge.render import contributions, plan_view
from gsmerge.render import cuda as cuda_module
from gsmerge.render.colored import draw_colored
from gsmerge.render.photos import photos_of
from gsmerge.render.plan import Splats
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene, prepare

sys.path.append(str(Path(__file__).resolve().parents[2] / "gradient"))

import fake_gsplat
from reference_gradients import random_gaussians, turned_cameras


class _Draw(torch.autograd.Function):
    """The kernels' image of tensors that are elsewhere, and its gradients."""

    @staticmethod
    def forward(ctx: Any, camera: Any, background: Any, *tensors: Any) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.enable_grad():
            ctx.leaves = [tensor.inner.detach().clone().requires_grad_() for tensor in tensors]
            ctx.image, reached = draw_colored(tuple(ctx.leaves[:4]), ctx.leaves[4], camera, background.inner.numpy())
        reached = Elsewhere(reached)
        ctx.mark_non_differentiable(reached)
        return Elsewhere(ctx.image.detach()), reached

    @staticmethod
    def backward(ctx: Any, gradient: Any, _: Any) -> tuple[Any, ...]:
        found = torch.autograd.grad(ctx.image, ctx.leaves, gradient.inner, retain_graph=True)
        return None, None, *(Elsewhere(one) for one in found)


def draw_elsewhere(shape: Any, colors: Any, photos: DevicePhotos, view: int, background: Any, **near: Any) -> Any:
    assert all(isinstance(tensor, Elsewhere) for tensor in (*shape, colors, background, photos.images, photos.Ks))
    return _Draw.apply(photos.host.camera(view) | near, background, *shape, colors)


def peaks_elsewhere(gaussians: Any, photos: DevicePhotos, view: int) -> Any:
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    arrays = [getattr(gaussians, name).inner.contiguous().numpy() for name in names]
    with torch._C._DisableTorchDispatch():
        plan = plan_view(Splats(*arrays, origin=[0, 0, 0]), **photos.host.camera(view))
        inside = torch.zeros(len(gaussians), dtype=torch.bool)
        inside[torch.from_numpy(plan.ids).long()] = True
        return Elsewhere(torch.from_numpy(contributions(plan)[1])), Elsewhere(inside)


def prepared_scene(**settings: Any) -> PreparedScene:
    scene = scenes.make_scene(scenes.room(), scenes.arc(2, 32, 24), noise=0.01)
    options = CompactOptions().with_settings({"superpixels": "8%", "checkpoint": "none", **settings})
    return prepare(scene, options, RunLog())


@pytest.mark.parametrize(
    "settings",
    [
        {"fit_steps": 150, "half_res_share": 0.55},
        {"fit": "color", "robust": False},
        {"k": "mixed", "match": "aabb", "fit": "none", "robust": False},
        {"budget": 90, "k": 3, "fit": "none", "robust": False},
    ],
    ids=str,
)
def test_build_and_scores_stay_on_the_device(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (raster, full):
        monkeypatch.setattr(module, "draw", draw_elsewhere)
    monkeypatch.setattr("gsmerge.gpu.fit.peak_weights", peaks_elsewhere)
    prepared = prepared_scene(**settings)
    with SecondDevice():
        on_device = DeviceScene(prepared, DEVICE, begin)
        gaussians = on_device.build(prepared, prepared.limits.count, RunLog())
        psnr = on_device.input_psnr(prepared.frame.leave(gaussians), prepared)
    assert not isinstance(gaussians.means, Elsewhere)
    assert psnr > 15


class _Gsplat:
    """The stand-in for gsplat, for tensors that are elsewhere."""

    def __getattr__(self, name: str) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            assert all(isinstance(one, Elsewhere) for one in tree_flatten((args, kwargs))[0] if torch.is_tensor(one))
            args, kwargs = tree_map(lambda one: one.inner if isinstance(one, Elsewhere) else one, (args, kwargs))
            with torch._C._DisableTorchDispatch():
                made = getattr(fake_gsplat, name)(*args, **kwargs)
            return tree_map(lambda one: Elsewhere(one) if torch.is_tensor(one) else one, made)

        return call


def test_what_gsplat_is_given_and_gives_stays_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images, colours of harmonics and largest weights, as the kernels have them."""
    monkeypatch.setattr(cuda_module, "_gsplat", _Gsplat)
    gaussians, cameras = random_gaussians(30, 1), turned_cameras()
    gaussians = replace(gaussians, quats=torch.nn.functional.normalize(gaussians.quats))
    photos = photos_of(np.zeros((2, cameras.height, cameras.width, 3), np.float32), cameras.numpy())
    made: list[list[Any]] = []
    for device in (torch.device("cpu"), DEVICE):
        with SecondDevice():
            tensors, resident = upload_gaussians(gaussians, device), upload_photos(photos, device)
            images = raster.draw_all(tensors, resident)
            peaks, reached = raster.peak_weights(tensors, resident, 1)
            made.append([one.cpu() for one in (*images, peaks, reached & (peaks > 0))])
    for expected, ours in zip(*made, strict=True):
        torch.testing.assert_close(ours, expected, atol=1e-3, rtol=1e-3)
    assert float(made[0][0].max()) > 0.1


def test_the_second_device_refuses_what_a_gpu_refuses() -> None:
    with SecondDevice():
        far, near = torch.arange(4, device=DEVICE), torch.arange(4)
        assert isinstance(far + 1, Elsewhere)
        assert far.sum().item() == 6
        assert (far * 2).cpu().tolist() == [0, 2, 4, 6]
        assert isinstance(near.to(DEVICE), Elsewhere)
        far[1:3] += 5
        assert far.cpu().tolist() == [0, 6, 7, 3]
        with pytest.raises(AssertionError, match="two devices"):
            far + near
        with pytest.raises((RuntimeError, TypeError)):
            far.numpy()
