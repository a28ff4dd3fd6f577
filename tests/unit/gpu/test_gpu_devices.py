"""No function mixes the device with the CPU: everything once more on a second device that refuses it."""

from __future__ import annotations

from typing import Any

import pytest
import scenes
import torch
from other_device import DEVICE, Elsewhere, SecondDevice

from gsmerge import CompactOptions
from gsmerge.gpu import color, full, holdout, raster
from gsmerge.gpu.build import DeviceScene
from gsmerge.gpu.scene import DevicePhotos
from gsmerge.pipeline import begin
from gsmerge.render import contributions, plan_view
from gsmerge.render.colored import draw_colored
from gsmerge.render.plan import Splats
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene, prepare


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


def peaks_elsewhere(shapes: Any, photos: DevicePhotos, view: int) -> Any:
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    arrays = [getattr(shapes, name).inner.contiguous().numpy() for name in names]
    with torch._C._DisableTorchDispatch():
        plan = plan_view(Splats(*arrays, origin=[0, 0, 0]), **photos.host.camera(view))
        inside = torch.zeros(len(shapes), dtype=torch.bool)
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
    for module in (raster, full, holdout, color):
        monkeypatch.setattr(module, "draw", draw_elsewhere)
    monkeypatch.setattr("gsmerge.gpu.fit.peak_weights", peaks_elsewhere)
    prepared = prepared_scene(**settings)
    with torch.no_grad(), SecondDevice():
        on_device = DeviceScene(prepared, DEVICE, begin)
        gaussians = on_device.build(prepared, prepared.limits.count, RunLog())
        psnr = on_device.input_psnr(prepared.frame.leave(gaussians), prepared)
    assert not isinstance(gaussians.means, Elsewhere)
    assert psnr > 15


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
