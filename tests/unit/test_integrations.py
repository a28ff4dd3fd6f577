"""Adapters of other libraries, on stand-ins that have the fields of what these return."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scenes import arc, make_scene, move, room

from gsmerge import Gaussians, Scene, SceneError, compact_tensors, integrations
from gsmerge.geometry import covariances
from gsmerge.types import SH_C0, as_array

FAST: dict[str, Any] = {"effort": "draft", "superpixels": "10%", "fit": "none"}
SIZES = np.array([48, 36, 1.0])[:, None]
FLIP = np.diag([1.0, -1, -1, 1])


@pytest.fixture(scope="module")
def scene() -> Scene:
    turn, _ = cv2.Rodrigues(np.array([0.4, -0.7, 0.5]))
    return move(make_scene(room(), arc(3), degree=0), turn, 1.0, np.array([0.3, -0.2, 0.1]))


def photos_of(scene: Scene) -> np.ndarray:
    assert scene.images is not None
    return scene.images


def batch(values: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.asarray(values, np.float32))[None]


def family(scene: Scene) -> SimpleNamespace:
    """Gaussians as the pixelSplat family, AnySplat and Depth Anything 3 keep them, with harmonics of degree 1."""
    gaussians = scene.gaussians
    harmonics = np.concatenate([gaussians.sh0, np.full((len(gaussians), 3, 3), 0.01)], 1).transpose(0, 2, 1)
    return SimpleNamespace(
        means=batch(gaussians.means), scales=batch(gaussians.scales), rotations=batch(gaussians.quats),
        harmonics=batch(harmonics), opacities=batch(gaussians.opacities),
        covariances=batch(covariances(gaussians.quats.astype(np.float64), gaussians.scales.astype(np.float64))),
    )  # fmt: skip


def poses_of(scene: Scene, extrinsics: str, intrinsics: str) -> dict[str, torch.Tensor]:
    return {extrinsics: batch(np.linalg.inv(scene.cameras.viewmats)), intrinsics: batch(scene.cameras.Ks / SIZES)}


def prediction_of(scene: Scene, **more: Any) -> SimpleNamespace:
    fields: dict[str, Any] = {
        "gaussians": family(scene), "extrinsics": scene.cameras.viewmats[:, :3].astype(np.float32),
        "intrinsics": scene.cameras.Ks.astype(np.float32), "depth": np.ones((3, 36, 48), np.float32), "is_metric": 0,
        "processed_images": np.round(255 * photos_of(scene)).astype(np.uint8), "scale_factor": None,
    }  # fmt: skip
    return SimpleNamespace(**fields | more)


def assert_holds(given: dict[str, Any], scene: Scene, *, quats: bool = True) -> None:
    """What an adapter gives is the scene, and is taken."""
    gaussians = scene.gaussians
    n = len(gaussians)
    for name in ("means", "opacities", "sh0"):
        np.testing.assert_allclose(
            as_array(given[name]).reshape(n, -1), getattr(gaussians, name).reshape(n, -1), atol=2e-6
        )
    if quats:
        got = covariances(as_array(given["quats"]).astype(np.float64), as_array(given["scales"]).astype(np.float64))
        want = covariances(gaussians.quats.astype(np.float64), gaussians.scales.astype(np.float64))
        np.testing.assert_allclose(got, want, atol=1e-6)
    np.testing.assert_allclose(as_array(given["viewmats"])[:, :3], scene.cameras.viewmats[:, :3], atol=1e-5)
    np.testing.assert_allclose(as_array(given["Ks"]), scene.cameras.Ks, atol=1e-4)
    np.testing.assert_allclose(as_array(given["images"]), photos_of(scene), atol=0.003)
    small = compact_tensors(**given, **FAST)
    assert isinstance(small.means, torch.Tensor)
    assert 0 < len(small) < 0.3 * n
    assert small.report.psnr_after is not None
    assert small.report.psnr_after > 15


def test_depth_anything_3(scene: Scene) -> None:
    given = integrations.depth_anything_3(prediction_of(scene))
    assert_holds(given, scene)
    assert (given["shN"].shape[1], given["check_rotations"]) == (0, False)
    assert integrations.depth_anything_3(prediction_of(scene), sh_degree=1)["shN"].shape == (len(scene.gaussians), 3, 3)


def test_depth_anything_3_in_metres_and_after_writing_colmap(scene: Scene) -> None:
    """The nested models scale the poses alone; its COLMAP writer leaves intrinsics at the original photos' size."""
    metric, original = scene.cameras.viewmats[:, :3].copy(), scene.cameras.Ks * np.array([2.5, 2.4, 1])[:, None]
    metric[:, :, 3] *= 4
    prediction = prediction_of(scene, extrinsics=metric, is_metric=1, scale_factor=4.0, intrinsics=original)
    assert_holds(integrations.depth_anything_3(prediction), scene)
    np.testing.assert_array_equal(prediction.extrinsics, metric)


def test_depth_anything_3_without_gaussians(scene: Scene) -> None:
    with pytest.raises(SceneError, match=r"prediction: expected a field gaussians, found none; .*infer_gs=True"):
        integrations.depth_anything_3(prediction_of(scene, gaussians=None))


def test_anysplat(scene: Scene) -> None:
    """Voxels: fewer Gaussians than pixels, in another order."""
    rows = np.random.default_rng(0).permutation(len(scene.gaussians))[:-50]
    fewer = replace_gaussians(scene, scene.gaussians[rows])
    images, gaussians = batch(photos_of(scene).transpose(0, 3, 1, 2)), family(fewer)
    gaussians.rotations = gaussians.rotations[..., [1, 2, 3, 0]]  # w last, which its writer of files reorders
    given = integrations.anysplat(gaussians, poses_of(scene, "extrinsic", "intrinsic"), images)
    assert_holds(given, fewer)
    assert given["order"] == "none"
    two = family(fewer)
    two.means = two.means.repeat(2, 1, 1)
    with pytest.raises(SceneError, match="means: expected a batch of one scene, found shape"):
        integrations.anysplat(two, poses_of(scene, "extrinsic", "intrinsic"), images)


def replace_gaussians(scene: Scene, gaussians: Gaussians) -> Any:
    """A stand-in for a scene with any number of Gaussians."""
    return SimpleNamespace(gaussians=gaussians, cameras=scene.cameras, images=scene.images)


@pytest.mark.parametrize("wrapped", [False, True])
def test_depthsplat(scene: Scene, wrapped: bool) -> None:
    """Rotations beside the covariances are the cameras', and are not read."""
    gaussians = family(scene)
    del gaussians.rotations, gaussians.scales
    context = poses_of(scene, "extrinsics", "intrinsics")
    context["image"] = batch(photos_of(scene).transpose(0, 3, 1, 2))
    output = {"gaussians": gaussians, "depths": None} if wrapped else gaussians
    given = integrations.depthsplat(output, context)
    assert_holds(given, scene)
    np.testing.assert_allclose(torch.linalg.norm(given["quats"], dim=-1), 1, atol=1e-5)


def trained(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    tensors = gaussians.to("cpu")
    logits = torch.logit(tensors.opacities.double()).float()
    means, scales = tensors.means.float(), tensors.scales.log()
    return {"means": means, "scales": scales, "quats": 2.5 * tensors.quats, "opacities": logits}


def test_gsplat(scene: Scene) -> None:
    harmonics = {"sh0": torch.tensor(scene.gaussians.sh0), "shN": torch.zeros(len(scene.gaussians), 15, 3)}
    splats = torch.nn.ParameterDict({**trained(scene.gaussians), **harmonics})
    photos = torch.tensor(np.round(255 * photos_of(scene)).astype(np.uint8))
    cameras = torch.tensor(scene.cameras.viewmats), torch.tensor(scene.cameras.Ks)
    assert_holds(integrations.gsplat(splats, *cameras, photos), scene)
    with pytest.raises(SceneError, match="splats: expected an entry 'sh0', found 'means'"):
        integrations.gsplat(trained(scene.gaussians))


def test_nerfstudio(scene: Scene) -> None:
    base = torch.tensor(scene.gaussians.sh0[:, 0])
    params = {**trained(scene.gaussians), "features_dc": base, "features_rest": torch.zeros(len(base), 15, 3)}
    params["opacities"] = params["opacities"][:, None]
    model = SimpleNamespace(gauss_params=torch.nn.ParameterDict(params), config=SimpleNamespace(sh_degree=3))
    c2w, K = np.linalg.inv(scene.cameras.viewmats) @ FLIP, scene.cameras.Ks
    columns = {"fx": K[:, 0, 0], "fy": K[:, 1, 1], "cx": K[:, 0, 2], "cy": K[:, 1, 2]}
    sizes = {"width": np.full(3, 48), "height": np.full(3, 36)}
    fields = {name: torch.tensor(values)[:, None] for name, values in (columns | sizes).items()}
    cameras = SimpleNamespace(camera_to_worlds=torch.tensor(c2w[:, :3]), **fields)
    assert_holds(integrations.nerfstudio(model, cameras, photos_of(scene)), scene)
    cameras.width = torch.tensor([48, 48, 50])[:, None]
    with pytest.raises(SceneError, match=r"cameras: expected cameras of one size, found .* widths \[48, 50\]"):
        integrations.nerfstudio(model, cameras)


def test_nerfstudio_without_harmonics(scene: Scene) -> None:
    """With degree 0 it trains logits of colours."""
    rgb = (0.5 + SH_C0 * scene.gaussians.sh0[:, 0].astype(np.float64)).clip(0.01, 0.99)
    params = {**trained(scene.gaussians), "features_dc": torch.tensor(np.log(rgb / (1 - rgb)))}
    params["features_rest"] = torch.zeros(len(rgb), 0, 3)
    model = SimpleNamespace(gauss_params=params, config=SimpleNamespace(sh_degree=0))
    given = integrations.nerfstudio(model)
    np.testing.assert_allclose(given["colors"], rgb, atol=1e-6)
    assert len(compact_tensors(**given, **FAST)) > 0
