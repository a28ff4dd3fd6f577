"""A ``.glb`` has the layout of its specification, which a slow reader checks."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from slow_readers import drawn

from gsmerge.geometry.transforms import multiply_quats, sh0_to_rgb
from gsmerge.io import write_gaussians


def read_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the document of a binary glTF, and the attributes of its only primitive."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, size, kind, length % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    document, content = json.loads(data[20 : 20 + length]), data[28 + length :]
    (primitive,) = document["meshes"][0]["primitives"]
    assert (primitive["mode"], primitive["extensions"]["KHR_gaussian_splatting"]["kernel"]) == (0, "ellipse")
    attributes = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype({5126: "<f4", 5121: "u1", 5122: "<i2", 5123: "<u2"}[accessor["componentType"]])
        width, count = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]], accessor["count"]
        stride = view.get("byteStride", width * dtype.itemsize)
        rows = np.frombuffer(content, "u1", count * stride, view["byteOffset"]).reshape(count, stride)
        values = rows[:, : width * dtype.itemsize].copy().view(dtype)
        assert accessor.get("normalized", False) == (dtype.kind != "f")
        attributes[name] = values if dtype.kind == "f" else values / np.iinfo(dtype).max
        assert view["byteOffset"] % 4 == stride % 4 == view["byteLength"] - count * stride == 0
    return document, attributes


@pytest.mark.parametrize("degree", [0, 3])
def test_a_glb_holds_every_value_of_its_gaussians(degree: int, tmp_path: Path) -> None:
    gaussians = drawn(scenes.make_scene(scenes.room(), scenes.arc(3, 96, 72)), degree)
    write_gaussians(tmp_path / "a.glb", gaussians)
    document, actual = read_glb(tmp_path / "a.glb")
    prefix, n = "KHR_gaussian_splatting:", len(gaussians)
    half_turn = np.array([0, 0, 0, 1], np.float32)  # y up, in the rows themselves
    np.testing.assert_array_equal(actual["POSITION"], gaussians.means * np.float32([-1, -1, 1]))
    quats = multiply_quats(half_turn, gaussians.quats)
    np.testing.assert_allclose(actual[f"{prefix}ROTATION"][:, [3, 0, 1, 2]], quats, atol=1.6e-5)
    np.testing.assert_allclose(actual[f"{prefix}SCALE"], gaussians.scales, rtol=1e-5)
    np.testing.assert_allclose(actual[f"{prefix}OPACITY"][:, 0], gaussians.opacities, atol=0.8e-5)
    np.testing.assert_array_equal(actual[f"{prefix}SH_DEGREE_0_COEF_0"], gaussians.sh0[:, 0])
    places = [(d, i) for d in range(1, degree + 1) for i in range(2 * d + 1)]
    harmonics = [actual[f"{prefix}SH_DEGREE_{d}_COEF_{i}"] for d, i in places]
    signs = np.array([-1 if (i - d) % 2 else 1 for d, i in places]).reshape(-1, 1)
    np.testing.assert_array_equal(np.stack([np.zeros((n, 3)), *harmonics], 1)[:, 1:], gaussians.shN * signs)
    assert len(actual) == 6 + len(places)
    shown = sh0_to_rgb(gaussians.sh0[:, 0].astype(np.float64)).clip(0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # as glTF has colours
    np.testing.assert_allclose(actual["COLOR_0"][:, :3], linear, atol=0.51 / 255)
    assert actual["COLOR_0"].shape == (n, 4)
    low = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]["min"]
    np.testing.assert_array_equal(low, actual["POSITION"].min(0))
    assert document["nodes"] == [{"mesh": 0}]
