"""CUDA tensors go to gsplat: its adapter on the CPU with a stand-in, and both backends on a GPU where there is one."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_gsplat import forget, install
from messages import refuses
from slow_renderer import BACKGROUND, NAMES, assert_close, leaves, pixel_gradients, random_gaussians
from slow_renderer import turned_cameras as cameras_of
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from gsmerge import Cameras, Gaussians, render
from gsmerge.errors import GsmergeError
from gsmerge.raster import Rendering, contributions, plan_view, prepare
from gsmerge.raster import cuda as adapter
from gsmerge.raster.autograd import draw_colored, seen_colors
from gsmerge.raster.cuda import harmonic_colors, rasterize, render_cuda

Calls = list[dict[str, Any]]
DEFAULTS: dict[str, Any] = {"antialiased": False, "near": 0.01, "far": 1e10, "with_depths": False}
gpu = pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a CUDA device and gsplat"
)


def by_adapter(gaussians: Gaussians, cameras: Cameras, background: Any = BACKGROUND, **options: Any) -> Rendering:
    return render_cuda(gaussians, cameras, np.array(background, np.float32), **{**DEFAULTS, **options})


def psnr(one: Tensor, other: Tensor) -> float:
    return float(-10 * (one.double() - other.double()).square().mean().clamp_min(1e-20).log10())


def assert_same(actual: Rendering, expected: Rendering, least: float = 80.0) -> None:
    """Images and alphas to ``least`` dB, mean depths to a thousandth in 99 % of what was drawn."""
    assert (actual.images.shape, actual.alphas.shape) == (expected.images.shape, expected.alphas.shape)
    assert actual.images.dtype == actual.alphas.dtype == torch.float32
    assert psnr(actual.images, expected.images) >= least
    assert psnr(actual.alphas, expected.alphas) >= least
    assert (actual.depths is None) == (expected.depths is None)
    if actual.depths is not None and expected.depths is not None:
        assert actual.depths.shape == expected.depths.shape
        solid = expected.alphas > 0.1
        close = torch.isclose(actual.depths[solid], expected.depths[solid], rtol=1e-3)
        assert close.double().mean() > 0.99  # but where a weight falls on the other side of the cut


# the adapter, with a stand-in for gsplat


@pytest.mark.parametrize("degree", range(5))
def test_images_are_the_cpu_s(degree: int, fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(40, degree, degree), cameras_of()
    assert_same(by_adapter(gaussians, cameras), render(gaussians, cameras, BACKGROUND))
    assert len(fake_gsplat) == len(cameras)  # view by view: all at once would copy the harmonics for each


@pytest.mark.parametrize(
    "options",
    [{"antialiased": True}, {"near": 2.9}, {"far": 3.1}, {"with_depths": True}, {"near": 2.0, "with_depths": True}],
    ids=str,
)
def test_options_mean_the_same(options: dict[str, Any], fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(40, 1), cameras_of()
    expected = render(gaussians, cameras, BACKGROUND, **options)
    assert_same(by_adapter(gaussians, cameras, **options), expected)
    if not options.get("with_depths"):
        assert psnr(expected.images, render(gaussians, cameras, BACKGROUND).images) < 60  # the option matters here


def test_what_gsplat_is_told(fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(9, 2), cameras_of(3)
    by_adapter(gaussians, cameras, antialiased=True, near=0.5, far=7.0, with_depths=True)
    by_adapter(gaussians, cameras)
    first, second = fake_gsplat[0], fake_gsplat[-1]
    assert (first["width"], first["height"], first["sh_degree"]) == (cameras.width, cameras.height, 2)
    assert (first["near_plane"], first["far_plane"], first["eps2d"]) == (0.5, 7.0, 0.3)
    assert (first["render_mode"], first["rasterize_mode"]) == ("RGB+ED", "antialiased")
    assert (second["render_mode"], second["rasterize_mode"]) == ("RGB", "classic")
    assert torch.equal(first["colors"], torch.cat([gaussians.sh0, gaussians.shN], 1))
    assert torch.equal(first["quats"], gaussians.quats)
    assert torch.equal(first["scales"], gaussians.scales)
    assert torch.equal(first["opacities"], gaussians.opacities)
    assert torch.equal(first["Ks"], cameras.Ks[:1].float())
    assert torch.equal(second["Ks"], cameras.Ks[2:].float())


@pytest.mark.parametrize("degree", [0, 3])
def test_gradients_are_the_cpu_s(degree: int, fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(40, degree, 1), cameras_of()
    actual, expected = (gradients(draw, gaussians, cameras) for draw in (by_adapter, on_cpu))
    assert_close(actual, [one.double() for one in expected])
    assert all(float(one.norm()) > 0 for one in expected if one.numel())


@pytest.mark.parametrize("eps2d", [0.3, 0.075])
def test_peaks_are_the_cpu_s(eps2d: float, fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(40), cameras_of(1)
    shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    camera = cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height
    peaks, reached = adapter.peak_weights(shape, camera, eps2d=eps2d)
    plan = plan_view(prepare(gaussians), cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height, eps2d=eps2d)
    expected = contributions(plan)[1]
    assert (expected > 0.01).sum() > 20
    np.testing.assert_allclose(peaks, expected, atol=2e-4)
    assert reached[torch.from_numpy(expected > 0)].all()
    assert len(adapter.peak_weights(tuple(tensor[:0] for tensor in shape), camera)[0]) == 0


def test_peaks_have_gsplat_s_clamp(fake_gsplat: Calls) -> None:
    """Of an opaque Gaussian whose centre is that of a pixel; in the image, too, so that the two agree."""
    shape = torch.tensor([[0.0, 0, 2]]), torch.eye(4)[:1], torch.ones(1, 3), torch.ones(1)
    camera = torch.eye(4), torch.tensor([[8.0, 0, 4.5], [0, 8, 4.5], [0, 0, 1]]), 9, 9
    assert float(adapter.peak_weights(shape, camera)[0]) == pytest.approx(adapter.MAX_ALPHA)
    image, *_ = rasterize(shape, torch.ones(1, 3), camera, torch.zeros(3))
    assert float(image.max()) == pytest.approx(adapter.MAX_ALPHA)


def test_nothing_to_list(fake_gsplat: Calls) -> None:
    """Behind the camera: no pixel has an entry."""
    gaussians, cameras = random_gaussians(5), cameras_of(1)
    behind = gaussians.means - torch.tensor([0.0, 0, 9])
    camera = cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height
    shape = behind, gaussians.quats, gaussians.scales, gaussians.opacities
    peaks, reached = adapter.peak_weights(shape, camera)
    assert not peaks.any()
    assert not reached.any()


def test_geographic_coordinates_keep_their_detail(fake_gsplat: Calls) -> None:
    """The adapter moves the scene in float64, and its gradients come back to where it was."""
    near, cameras = random_gaussians(30), cameras_of()
    place = torch.tensor([4.2e6, -1.7e5, 4.8e6], dtype=torch.float64)
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ place
    far, there = replace(near, means=near.means.double() + place), replace(cameras, viewmats=viewmats)
    assert_same(by_adapter(far, there), by_adapter(near, cameras), least=60)
    assert_same(by_adapter(far, there), render(far, there, BACKGROUND), least=60)
    actual, expected = (gradients(draw, far, there) for draw in (by_adapter, on_cpu))
    assert_close(actual, [one.double() for one in expected], most=1e-2)


def test_depths_have_no_gradient(fake_gsplat: Calls) -> None:
    *tensors, viewmats = leaves(random_gaussians(9), cameras_of())
    drawn = by_adapter(Gaussians(*tensors), replace(cameras_of(), viewmats=viewmats), with_depths=True)
    assert drawn.images.requires_grad
    assert not drawn.depths.requires_grad


def test_zero_quaternions_are_no_rotation(fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(12), cameras_of()
    gaussians = replace(gaussians, quats=gaussians.quats * (torch.arange(12) % 3 > 0)[:, None])
    assert_same(by_adapter(gaussians, cameras), render(gaussians, cameras, BACKGROUND))


@pytest.mark.parametrize("with_depths", [False, True])
def test_nothing_to_draw(with_depths: bool, fake_gsplat: Calls) -> None:
    """Background, still differentiable, and gsplat is not asked."""
    gaussians, cameras = random_gaussians(9, 1), cameras_of()
    for some, seen in ((gaussians[:0], cameras), (gaussians, cameras[:0])):
        actual, expected = (draw(some, seen, with_depths=with_depths) for draw in (by_adapter, on_cpu))
        for name in ("images", "alphas"):
            assert torch.equal(getattr(actual, name), getattr(expected, name))
        assert (actual.depths is None) == (not with_depths)
    assert all((one == 0).all() for one in gradients(by_adapter, gaussians[:0], cameras))
    assert fake_gsplat == []


@pytest.mark.parametrize("options", [{"near": 0.0}, {"near": 3.0, "far": 2.0}], ids=str)
def test_depth_range_is_checked(options: dict[str, Any], fake_gsplat: Calls) -> None:
    with pytest.raises(ValueError, match="0 < near < far"):
        by_adapter(random_gaussians(3), cameras_of(), **options)


def test_given_colours_and_dilation_pass(fake_gsplat: Calls) -> None:
    """What the fit draws: colours of any sign, a dilation of its own, against the kernels and their gradients."""
    gaussians, cameras = random_gaussians(40), cameras_of(1)
    colors = torch.randn(40, 3, generator=torch.Generator().manual_seed(3))
    viewmat, K = cameras.viewmats[0], cameras.Ks[0]
    camera = {"viewmat": viewmat.numpy(), "K": K.numpy(), "width": 37, "height": 21, "eps2d": 0.075}
    background = np.array(BACKGROUND, np.float32)
    grad_image, _ = pixel_gradients(cameras)
    actual = []
    for fast in (True, False):
        tensors = [t.clone().requires_grad_() for t in (*list(vars(gaussians).values())[:4], colors)]
        shape = (tensors[0], tensors[1], tensors[2], tensors[3])
        if fast:
            image, reached = draw_colored(shape, tensors[4], camera, background)
            assert reached.shape == (len(colors),)
        else:
            under = torch.from_numpy(background)
            image, alpha, depth, reached = rasterize(shape, tensors[4], (viewmat, K, 37, 21), under, eps2d=0.075)
            assert (alpha.shape, depth, reached.shape) == ((21, 37, 1), None, (len(tensors[4]),))
        (image * grad_image[0]).sum().backward()
        actual.append((image.detach(), [tensor.grad for tensor in tensors]))
    assert psnr(actual[0][0], actual[1][0]) > 80
    assert_close(actual[0][1], [one.double() for one in actual[1][1]])
    assert fake_gsplat[0]["eps2d"] == 0.075
    assert fake_gsplat[0]["sh_degree"] is None


@pytest.mark.parametrize("degree", [1, 4])
def test_seen_colours(degree: int, fake_gsplat: Calls) -> None:
    gaussians, cameras = random_gaussians(20, degree), cameras_of(1)
    harmonics = torch.cat([gaussians.sh0, gaussians.shN], 1)
    actual = harmonic_colors(gaussians.means, harmonics, cameras.centres[0].float())
    expected = seen_colors(gaussians.means, gaussians.sh0, gaussians.shN, cameras.viewmats[0].numpy())
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
    assert (expected == 0).any()


# who draws


def test_cuda_tensors_go_to_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    """By their device alone; these have no memory behind them."""
    asked = []
    monkeypatch.setattr(adapter, "render_cuda", lambda *args, **options: asked.append((args, options)))
    with FakeTensorMode():
        gaussians = Gaussians(
            *(torch.empty(4, *size, device="cuda") for size in ((3,), (4,), (3,), (), (1, 3), (0, 3)))
        )
        cameras = Cameras(torch.empty(1, 4, 4, device="cuda"), torch.empty(1, 3, 3, device="cuda"), 8, 6)
        render(gaussians, cameras, 0.5, near=0.2, antialiased=True)
    ((args, options),) = asked
    assert args[:2] == (gaussians, cameras)
    assert args[2].tolist() == [0.5] * 3
    assert options == {"antialiased": True, "near": 0.2, "far": 1e10, "with_depths": False}


@pytest.mark.parametrize("with_depths", [False, True])
def test_gsplat_gets_tensors_of_the_device_alone(with_depths: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tensors that have a device and no memory: mixing devices would fail."""
    install(monkeypatch, compiled=object())
    module = sys.modules["gsplat"]

    def rasterization(**given: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        assert all(value.is_meta for value in given.values() if isinstance(value, Tensor))
        size = len(given["viewmats"]), given["height"], given["width"]
        channels = 4 if given["render_mode"] == "RGB+ED" else 3
        radii = torch.empty(len(given["viewmats"]), len(given["means"]), 2, device="meta")
        return torch.empty(*size, channels, device="meta"), torch.empty(*size, 1, device="meta"), {"radii": radii}

    def spherical_harmonics(degree: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
        assert dirs.is_meta
        return coeffs[:, degree]

    module.rasterization, module.spherical_harmonics = rasterization, spherical_harmonics
    gaussians, cameras = random_gaussians(4, 1).to("meta"), cameras_of().to("meta")
    for some in (gaussians, gaussians[:0]):
        drawn = by_adapter(some, cameras, with_depths=with_depths)
        assert (drawn.images.shape, drawn.alphas.shape) == ((2, 21, 37, 3), (2, 21, 37, 1))
        assert drawn.images.is_meta
        assert drawn.depths is None or (drawn.depths.is_meta and drawn.depths.shape == (2, 21, 37, 1))
    harmonics = torch.cat([gaussians.sh0, gaussians.shN], 1)
    assert harmonic_colors(gaussians.means, harmonics, gaussians.means[0]).is_meta


def test_devices_must_agree() -> None:
    gaussians, cameras = random_gaussians(3), cameras_of()
    with refuses(ValueError, "", "cpu", "meta"):
        render(gaussians, cameras.to("meta"))
    with refuses(ValueError, "", "cpu", "meta"):
        render(replace(gaussians, sh0=gaussians.sh0.to("meta")), cameras)


def test_without_gsplat_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    forget(monkeypatch)
    with pytest.raises(GsmergeError, match=r'gsplat, but .*; pip install "gsplat>=1.5,<1.6"$'):
        by_adapter(random_gaussians(3), cameras_of())


def test_gsplat_without_its_compiled_part_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a wheel and a compiler gsplat can be imported, and fails at its first kernel."""
    install(monkeypatch, compiled=None)
    with pytest.raises(GsmergeError, match="toolkit"):
        by_adapter(random_gaussians(3), cameras_of())


def test_gsplat_that_cannot_be_compiled_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line, and once: compiling takes minutes. What gsplat prints stays off standard output."""
    folder = tmp_path / "gsplat" / "cuda"
    folder.mkdir(parents=True)
    for name in ("__init__.py", "cuda/__init__.py"):
        (tmp_path / "gsplat" / name).touch()
    fails = 'print("gsplat: Setting up CUDA")\nraise RuntimeError("Error building extension\\nninja: failed")\n'
    (folder / "_backend.py").write_text(fails)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    forget(monkeypatch)
    for _ in range(2):
        with refuses(GsmergeError, "", "gsplat", "RuntimeError", "extension"):
            by_adapter(random_gaussians(3), cameras_of())
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("Setting up CUDA")) == ("", 1)


# both backends, on a GPU


@gpu
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_draws_the_cpu_s_images(degree: int, antialiased: bool) -> None:
    """60 dB leaves room for weights that fall on the other side of the cut, 1/255, in 6 % of the pixels."""
    gaussians, cameras = random_gaussians(300, degree), cameras_of(3)
    options = {"antialiased": antialiased, "with_depths": True}
    actual = render(gaussians.to("cuda"), cameras.to("cuda"), BACKGROUND, **options)
    assert actual.images.is_cuda
    actual = Rendering(*(part.cpu() for part in vars(actual).values()))
    assert_same(actual, render(gaussians, cameras, BACKGROUND, **options), least=60)


@gpu
def test_opaque_ones_differ_by_the_clamp_alone() -> None:
    """0.999 or 0.99: 0.009 of a contrast of 1 in every pixel is 40.9 dB; the slow renderer with both gives 55 here."""
    gaussians, cameras = random_gaussians(300), cameras_of(3)
    colors = torch.rand(300, 1, 3, generator=torch.Generator().manual_seed(0))
    gaussians = replace(gaussians, opacities=torch.ones(300), sh0=(colors - 0.5) / 0.28209479177387814)
    actual, expected = render(gaussians.to("cuda"), cameras.to("cuda")), render(gaussians, cameras)
    assert psnr(actual.images.cpu(), expected.images) >= 40


@gpu
@pytest.mark.parametrize("degree", [0, 3])
def test_gsplat_has_the_cpu_s_gradients(degree: int) -> None:
    gaussians, cameras = random_gaussians(300, degree), cameras_of(3)
    expected = gradients(on_cpu, gaussians, cameras)
    actual = gradients(on_cpu, gaussians.to("cuda"), cameras.to("cuda"))
    assert_close([one.cpu() for one in actual], [one.double() for one in expected], most=1e-2)


def on_cpu(gaussians: Gaussians, cameras: Cameras, **options: Any) -> Rendering:
    return render(gaussians, cameras, BACKGROUND, **options)


def gradients(draw: Any, gaussians: Gaussians, cameras: Cameras) -> list[Tensor]:
    """Of images and alphas times fixed numbers, in the order of NAMES, of the view matrices along rigid motions."""
    *tensors, viewmats = leaves(gaussians, cameras)
    drawn = draw(Gaussians(*tensors), replace(cameras, viewmats=viewmats))
    grads = [one.to(drawn.images) for one in pixel_gradients(cameras)]
    ((drawn.images * grads[0]).sum() + (drawn.alphas * grads[1]).sum()).backward()
    assert len(tensors) + 1 == len(NAMES)
    actual = [torch.zeros_like(one) if one.grad is None else one.grad for one in (*tensors, viewmats)]
    return [*actual[:-1], rigid(actual[-1], cameras)]


def rigid(gradient: Tensor, cameras: Cameras) -> Tensor:
    """``[c,3,4]`` part of a view matrix's gradient along turns (as a skew matrix) and shifts."""
    turn = gradient[:, :3, :3] @ cameras.viewmats[:, :3, :3].transpose(1, 2)
    return torch.cat([turn - turn.transpose(1, 2), gradient[:, :3, 3:]], 2)
