"""Adapters of other libraries, on stand-ins that have the fields of what these return."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from messages import noted, refuses
from scenes import arc, make_scene, move, room

from gsmerge import Gaussians, Scene, SceneError, compact_tensors, integrations
from gsmerge.arrays import as_array
from gsmerge.method.geometry.transforms import covariances, multiply_quats, rgb_to_sh0, rotmat_to_quat, sh0_to_rgb

torch = pytest.importorskip("torch", reason="torch is not installed")

FAST: dict[str, Any] = {"effort": "draft", "superpixels": "10%", "fit": "none", "poses": "fixed"}
SIZES = np.array([48, 36, 1.0])[:, None]


@pytest.fixture(scope="module")
def scene() -> Scene:
    turn, _ = cv2.Rodrigues(np.array([0.4, -0.7, 0.5]))
    return move(make_scene(room(), arc(3), degree=0), turn, 1.0, np.array([0.3, -0.2, 0.1]))


def photos_of(scene: Scene) -> np.ndarray:
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
    assert isinstance(small.gaussians.means, torch.Tensor)
    assert 0 < len(small.gaussians) < 0.3 * n
    assert small.report.psnr_after > 15


def test_output_of_depth_anything_3_holds_the_scene(scene: Scene) -> None:
    given = integrations.depth_anything_3(prediction_of(scene))
    assert_holds(given, scene)
    assert given["shN"].shape[1] == 0
    assert integrations.depth_anything_3(prediction_of(scene), sh_degree=1)["shN"].shape == (len(scene.gaussians), 3, 3)


def test_rotations_of_depth_anything_3_get_no_note(scene: Scene) -> None:
    """It takes a camera's rotations wxyz for xyzw, turns them so into the world, and makes the last entry positive."""
    camera_quats = rotmat_to_quat(scene.cameras.viewmats[:, :3, :3].swapaxes(1, 2)).repeat(scene.pixels_per_view, 0)
    wxyz = multiply_quats(camera_quats * (1, -1, -1, -1), scene.gaussians.quats.astype(np.float64))
    turned = multiply_quats(camera_quats, wxyz[:, [3, 0, 1, 2]])[:, [1, 2, 3, 0]]
    turned *= np.where(turned[:, 3:] < 0, -1, 1)
    gaussians = family(scene)
    gaussians.rotations = batch(turned)
    notes = compact_tensors(
        **integrations.depth_anything_3(prediction_of(scene, gaussians=gaussians)), **FAST
    ).report.notes
    assert turned[:, 0].min() < 0
    assert not noted(notes, "w", "last")


def test_depth_anything_3_in_metres_and_after_writing_colmap_holds_the_scene(scene: Scene) -> None:
    """The nested models scale the poses alone; its COLMAP writer leaves intrinsics at the original photos' size."""
    metric, original = scene.cameras.viewmats[:, :3].copy(), scene.cameras.Ks * np.array([2.5, 2.4, 1])[:, None]
    metric[:, :, 3] *= 4
    prediction = prediction_of(scene, extrinsics=metric, is_metric=1, scale_factor=4.0, intrinsics=original)
    assert_holds(integrations.depth_anything_3(prediction), scene)
    np.testing.assert_array_equal(prediction.extrinsics, metric)


def test_output_of_depth_anything_3_without_gaussians_is_refused(scene: Scene) -> None:
    with refuses(SceneError, "prediction", "gaussians", "infer_gs=True"):
        integrations.depth_anything_3(prediction_of(scene, gaussians=None))


def test_output_of_anysplat_holds_the_scene(scene: Scene) -> None:
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
    with refuses(SceneError, "means", [2, 5134, 3]):
        integrations.anysplat(two, poses_of(scene, "extrinsic", "intrinsic"), images)


def replace_gaussians(scene: Scene, gaussians: Gaussians) -> Any:
    """A stand-in for a scene with any number of Gaussians."""
    return SimpleNamespace(gaussians=gaussians, cameras=scene.cameras, images=scene.images)


@pytest.mark.parametrize("wrapped", [False, True])
def test_output_of_depthsplat_holds_the_scene(scene: Scene, wrapped: bool) -> None:
    """Rotations beside the covariances are the cameras', and are not read."""
    gaussians = family(scene)
    del gaussians.rotations, gaussians.scales
    context = poses_of(scene, "extrinsics", "intrinsics")
    context["image"] = batch(photos_of(scene).transpose(0, 3, 1, 2))
    output = {"gaussians": gaussians, "depths": None} if wrapped else gaussians
    given = integrations.depthsplat(output, context)
    assert_holds(given, scene)
    np.testing.assert_allclose(torch.linalg.norm(given["quats"], dim=-1), 1, atol=1e-5)


def ffgs_cameras(scene: Scene) -> SimpleNamespace:
    c2w = np.linalg.inv(scene.cameras.viewmats)
    return SimpleNamespace(c2w=batch(c2w), pixel_k=batch(scene.cameras.Ks), image_shape=(36, 48))


def ffgs_output(scene: Scene, degree: int | None, cameras: Any) -> SimpleNamespace:
    """What ffgs returns: harmonics basis-major or colours, and rows of opacity 0 that fill a batch up."""
    g = scene.gaussians
    colors = sh0_to_rgb(g.sh0)[:, 0]
    if degree is not None:
        colors = np.concatenate([g.sh0, np.full((len(g), (degree + 1) ** 2 - 1, 3), 0.01)], 1)
    columns = {"means": g.means, "scales": g.scales, "quats": g.quats, "opacities": g.opacities, "colors": colors}
    padded = {name: batch(np.concatenate([column, 0 * column[:7]])) for name, column in columns.items()}
    return SimpleNamespace(gaussians=SimpleNamespace(**padded, sh_degree=degree), frame=None, cameras=cameras)


@pytest.mark.parametrize("degree", [None, 0, 1])
@pytest.mark.parametrize("given", [False, True])
def test_output_of_ffgs_holds_the_scene(scene: Scene, degree: int | None, given: bool) -> None:
    cameras = ffgs_cameras(scene)
    images = batch(photos_of(scene).transpose(0, 3, 1, 2))
    output = ffgs_output(scene, degree, None if given else cameras)
    arguments = integrations.ffgs(output, images, cameras if given else None)
    if degree is None:
        arguments["sh0"] = rgb_to_sh0(arguments.pop("colors"))
    else:
        assert arguments["shN"].shape[1] == 3 * degree
    assert_holds(arguments, scene)
    assert arguments["order"] == "none"


def test_output_of_ffgs_without_photos_or_cameras_is_compacted(scene: Scene) -> None:
    arguments = integrations.ffgs(ffgs_output(scene, 0, ffgs_cameras(scene)))
    assert (arguments["shape"], "images" in arguments) == ((3, 36, 48), False)
    assert 0 < len(compact_tensors(**arguments, **FAST).gaussians) < 0.3 * len(scene.gaussians)
    assert "viewmats" not in integrations.ffgs(ffgs_output(scene, 0, None))
    with refuses(SceneError, "output", "gaussians"):
        integrations.ffgs(SimpleNamespace(gaussians=None, cameras=None))


def test_output_of_worldmirror_holds_the_scene(scene: Scene) -> None:
    """Voxels: fewer Gaussians than pixels; columns are lists of one scene, or have its axis."""
    fewer = replace_gaussians(scene, scene.gaussians[::2])
    g = fewer.gaussians
    columns = {"means": g.means, "scales": g.scales, "quats": g.quats, "opacities": g.opacities, "sh": g.sh0}
    splats: dict[str, Any] = {name: batch(column) for name, column in columns.items()}
    splats["means"] = [splats["means"][0]]
    predictions: dict[str, Any] = {"splats": splats, "camera_poses": batch(np.linalg.inv(scene.cameras.viewmats))}
    predictions["camera_intrs"] = batch(scene.cameras.Ks)
    images = batch(photos_of(scene).transpose(0, 3, 1, 2))
    given = integrations.worldmirror(predictions, images)
    assert_holds(given | {"shN": torch.zeros(len(g), 0, 3)}, fewer)
    assert given["order"] == "none"
    with refuses(SceneError, "predictions", "splats"):
        integrations.worldmirror({}, images)
    with refuses(SceneError, "means", 2):
        integrations.worldmirror(predictions | {"splats": splats | {"means": [0, 0]}}, images)
