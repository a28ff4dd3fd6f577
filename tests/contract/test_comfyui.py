"""The nodes for ComfyUI work on the interface of ComfyUI 0.27, for which modules stand in."""

from __future__ import annotations

import asyncio
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from comfyui import Bar, CancelError, Splat, modules
from shared import make_once, write_small

import gsmerge
from gsmerge.method.kernels.elementary import arctan2

torch = pytest.importorskip("torch", reason="torch is not installed")

FLIP = np.diag([1.0, -1, -1])  # between three.js' axes and OpenCV's


@pytest.fixture
def nodes(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for name, module in modules(tmp_path).items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("gsmerge_nodes", root / "examples" / "comfyui" / "__init__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("seen", "cancelled"):
        monkeypatch.setattr(Bar, name, [])
    return module


@pytest.fixture
def scene() -> gsmerge.Scene:
    return gsmerge.read_scene(make_once("small", write_small))


def make_splat(*items: gsmerge.Gaussians) -> Splat:
    """Return a batch as ComfyUI holds it."""
    columns = [(g.means, g.scales, g.quats, g.opacities[:, None], np.concatenate([g.sh0, g.shN], 1)) for g in items]
    tensors = [[torch.from_numpy(np.ascontiguousarray(column)) for column in row] for row in columns]
    padded = [torch.nn.utils.rnn.pad_sequence(list(row), batch_first=True) for row in zip(*tensors, strict=True)]
    return Splat(*padded, torch.tensor([len(g) for g in items]) if len(items) > 1 else None)


def make_cameras(cameras: gsmerge.Cameras) -> list[dict[str, Any]]:
    """Return cameras as ComfyUI holds them: y up, looking along -z."""
    out = []
    for viewmat, K in zip(cameras.viewmats, cameras.Ks, strict=True):
        pose = np.linalg.inv(viewmat)
        rotation, eye = FLIP @ pose[:3, :3] @ FLIP, FLIP @ pose[:3, 3]
        w = np.sqrt(max(0, 1 + np.trace(rotation))) / 2
        x, y, z = (rotation[[2, 0, 1], [1, 2, 0]] - rotation[[1, 2, 0], [2, 0, 1]]) / (4 * w)
        fov = 2 * np.degrees(float(arctan2(min(cameras.width, cameras.height) / 2, K[0, 0])))
        places = {"position": eye, "target": eye - rotation[:, 2]}
        camera = {name: dict(zip("xyz", place, strict=True)) for name, place in places.items()}
        out.append({**camera, "quaternion": {"w": w, "x": x, "y": y, "z": z}, "fov": fov, "cameraType": "perspective"})
    return out


def test_nodes_have_what_comfyui_calls(nodes: ModuleType) -> None:
    """The inputs of a schema are the arguments of ``execute``; the folder has two nodes and under 150 lines."""
    listed = asyncio.run(asyncio.run(nodes.comfy_entrypoint()).get_node_list())
    assert [node.__name__ for node in listed] == ["CompactGaussians", "CompactFile"]
    for node in listed:
        arguments = inspect.signature(node.execute).parameters
        inputs = node.define_schema().inputs
        assert [item["id"] for item in inputs] == list(arguments)
        optional = {name for name, argument in arguments.items() if argument.default is not inspect.Parameter.empty}
        assert optional == {item["id"] for item in inputs if item["optional"]}
    assert len(Path(str(nodes.__file__)).read_text().splitlines()) < 150


def test_cameras_are_those_of_the_scene(nodes: ModuleType, scene: gsmerge.Scene) -> None:
    """With a quaternion exactly; without one the same way, and upright."""
    for camera, viewmat, K in zip(make_cameras(scene.cameras), scene.cameras.viewmats, scene.cameras.Ks, strict=True):
        placed, intrinsics = nodes.place_camera(camera, scene.cameras.width, scene.cameras.height)
        np.testing.assert_allclose(placed, viewmat, atol=1e-5)
        assert intrinsics[0, 0] == pytest.approx(K[0, 0], rel=1e-5)
        upright, _ = nodes.place_camera(camera | {"quaternion": None}, scene.cameras.width, scene.cameras.height)
        np.testing.assert_allclose(upright[2], viewmat[2], atol=1e-5)
        assert abs(upright[0, 1]) < 1e-6
    with pytest.raises(ValueError, match="perspective"):
        nodes.place_camera(camera | {"cameraType": "orthographic"}, 8, 8)


def test_splats_are_fitted_to_images(nodes: ModuleType, scene: gsmerge.Scene) -> None:
    images = [torch.from_numpy(np.stack(list(scene.images[i : i + 1]))).float() for i in range(len(scene.images))]
    views = {"images": images, "camera_info": make_cameras(scene.cameras)}
    splat = make_splat(scene.gaussians)
    result = nodes.CompactGaussians.execute(splat=[splat], budget=["300"], effort=["draft"], **views)
    (small,), (report,) = result.args
    assert small.positions.shape == (1, 300, 3)
    assert small.opacities.shape == (1, 300, 1)
    assert small.sh.shape == (1, 300, small.sh.shape[2], 3)
    assert "of its own views" in report
    assert Bar.seen == sorted(Bar.seen)
    assert Bar.seen[-1] == 1000
    with pytest.raises(ValueError, match=f"each of {len(images)} images, found 1"):
        nodes.CompactGaussians.execute([splat], ["300"], ["draft"], images, views["camera_info"][:1])
    with pytest.raises(ValueError, match="both of them, and one splat"):
        nodes.CompactGaussians.execute([splat], ["300"], ["draft"], images)


@pytest.mark.slow
def test_batches_are_compacted_one_by_one(nodes: ModuleType, scene: gsmerge.Scene) -> None:
    batch = make_splat(scene.gaussians[::2], scene.gaussians[::3])
    (result, alone), reports = nodes.CompactGaussians.execute(
        [batch, make_splat(scene.gaussians[::3])], ["10%"], ["draft"]
    ).args
    counts = [len(scene.gaussians[::2]) // 10, len(scene.gaussians[::3]) // 10]
    assert result.counts.tolist() == pytest.approx(counts, abs=1)
    assert result.positions.shape[:2] == (2, max(result.counts))
    assert torch.equal(result.positions[1, : result.counts[1]], alone.positions[0])
    assert len(reports) == 3


def test_run_of_a_node_ends_when_it_is_cancelled(nodes: ModuleType, scene: gsmerge.Scene) -> None:
    Bar.cancelled.append(True)
    with pytest.raises(CancelError):
        nodes.CompactGaussians.execute([make_splat(scene.gaussians)], ["300"], ["draft"])


def test_a_folder_becomes_a_file(nodes: ModuleType, small_scene: Path, tmp_path: Path) -> None:
    assert nodes.CompactFile.fingerprint_inputs(str(small_scene), budget="") > 0
    assert nodes.CompactFile.fingerprint_inputs("missing") == 0
    file, report = nodes.CompactFile.execute(str(small_scene), "", "draft", "spz", "3d/small").args
    assert Path(file.source) == tmp_path / "output" / "3d" / "small_00001_.spz"
    assert len(gsmerge.read_gaussians(file.source).gaussians) < 7680
    assert "7,680 ->" in report
    with pytest.raises(gsmerge.SceneError, match="no such file"):
        nodes.CompactFile.execute("missing", "", "draft", "ply", "3d/small")
