"""``.glb`` are written by the specification, and read: gsmerge's own, and those of other writers and drafts."""

from __future__ import annotations

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from messages import refuses
from slow_readers import drawn

from gsmerge import Gaussians, Scene
from gsmerge.errors import SceneError, list_doubts
from gsmerge.io import read_gaussians, write_gaussians
from gsmerge.io.cameras.viewer_cameras import order_views
from gsmerge.io.formats.glb import holds_gaussians
from gsmerge.io.formats.read_gaussians import file_notes
from gsmerge.io.formats.table import Contents
from gsmerge.method.geometry.transforms import multiply_quats, project, quat_to_rotmat, sh0_to_rgb
from gsmerge.method.kernels.elementary import cos, sin
from gsmerge.results.outputs import name_outputs, write_outputs

NAME = "KHR_gaussian_splatting"
NUMBERS = {"<f4": 5126, "|i1": 5120, "|u1": 5121, "<i2": 5122, "<u2": 5123}
Document = dict[str, Any]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 48, 36))


def attributes_of(g: Gaussians) -> dict[str, np.ndarray]:
    """Name the columns of Gaussians, as in the specification."""
    columns = {"POSITION": g.means, f"{NAME}:ROTATION": g.quats[:, [1, 2, 3, 0]], f"{NAME}:SCALE": g.scales}
    columns |= {f"{NAME}:OPACITY": g.opacities[:, None], f"{NAME}:SH_DEGREE_0_COEF_0": g.sh0[:, 0]}
    places = [(d, i) for d in range(1, g.sh_degree + 1) for i in range(2 * d + 1)]
    columns |= {f"{NAME}:SH_DEGREE_{d}_COEF_{i}": g.shN[:, d * d - 1 + i] for d, i in places}
    return {name: values.astype("<f4") for name, values in columns.items()}


def save_glb(
    path: Path, columns: dict[str, np.ndarray], nodes: list[Document] | None = None, **splats: Any
) -> Document:
    """Write columns as one primitive of a ``.glb``; integers are normalised. Returns the document."""
    values = [np.ascontiguousarray(array) for array in columns.values()]
    starts = np.cumsum([0, *(array.nbytes + -array.nbytes % 4 for array in values)]).tolist()
    content = b"".join(array.tobytes() + bytes(-array.nbytes % 4) for array in values)
    views = [
        {"buffer": 0, "byteOffset": at, "byteLength": array.nbytes} for at, array in zip(starts, values, strict=False)
    ]
    accessors = [
        {"bufferView": i, "componentType": NUMBERS[array.dtype.str], "count": len(array),
         "normalized": array.dtype != "<f4", "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1]]}
        for i, array in enumerate(values)
    ]  # fmt: skip
    primitive = {"attributes": {name: i for i, name in enumerate(columns)}, "mode": 0, "extensions": {NAME: splats}}
    document = {
        "asset": {"version": "2.0"}, "extensionsUsed": [NAME], "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}], "meshes": [{"primitives": [primitive]}], "accessors": accessors,
        "bufferViews": views, "buffers": [{"byteLength": len(content)}],
    }  # fmt: skip
    write_document(path, document, content)
    return document


def write_scene(path: Path, scene: Scene, *, overwrite: bool = False) -> None:
    """Write Gaussians and cameras of a scene as a result."""
    outputs = name_outputs(path, overwrite=overwrite)
    write_outputs(outputs, Contents([scene.gaussians], cameras=scene.cameras, names=scene.names))


def write_document(path: Path, document: Document, content: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def assert_same_gaussians(actual: Gaussians, expected: Gaussians, atol: float = 2e-6) -> None:
    """Compare all columns, rotations up to their sign, and scales and sizes relative to their own."""
    sign = np.where((actual.quats * expected.quats).sum(1) < 0, -1, 1)[:, None]
    np.testing.assert_allclose(actual.quats * sign, expected.quats, atol=atol)
    np.testing.assert_allclose(actual.scales, expected.scales, rtol=5 * atol)
    for name in ("means", "opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), atol=atol, err_msg=name)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_glb_is_read_back_as_it_was_written(degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, degree)
    write_gaussians(tmp_path / "a.glb", gaussians)
    actual = read_gaussians(tmp_path / "a.glb")
    assert_same_gaussians(actual.gaussians, gaussians, 2e-5)  # rotations and opacities have 16 bits
    np.testing.assert_allclose(actual.gaussians.scales, gaussians.scales, rtol=1e-6)
    np.testing.assert_array_equal(actual.gaussians.means, gaussians.means)
    np.testing.assert_array_equal(actual.gaussians.shN, gaussians.shN)
    info = actual.info
    assert (info.count, info.sh_degree, info.opacity_encoding) == (len(gaussians), degree, "raw")
    assert sum(info.bytes_by_attribute.values()) == len(gaussians) * (3 * 12 + 8 + 2 + 12 * gaussians.shN.shape[1])


def test_axis_y_of_other_writers_points_up(scene: Scene, tmp_path: Path) -> None:
    """Half a turn about z: harmonics of odd order change their sign, which is how splat-transform writes them."""
    gaussians = drawn(scene, 3)
    save_glb(tmp_path / "a.glb", attributes_of(gaussians))
    orders = [order for degree in range(1, 4) for order in range(-degree, degree + 1)]
    signs = np.array([-1 if order % 2 else 1 for order in orders], np.float32)[:, None]
    half_turn = np.array([0, 0, 0, 1], np.float32)
    expected = Gaussians(
        gaussians.means * np.array([-1, -1, 1], np.float32), multiply_quats(half_turn, gaussians.quats),
        gaussians.scales, gaussians.opacities, gaussians.sh0, gaussians.shN * signs,
    )  # fmt: skip
    assert_same_gaussians(read_gaussians(tmp_path / "a.glb").gaussians, expected)


def test_nodes_of_a_glb_move_their_gaussians(scene: Scene, tmp_path: Path) -> None:
    """Two copies, of which one is moved by its node's parts, and one by the matrices of two nodes."""
    gaussians = drawn(scene, 0)
    turn = np.array([0.5, 0.1, -0.7, 0.2])
    turn /= np.linalg.norm(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_rotmat(turn[None])[0]
    nodes: list[Document] = [
        {"children": [1, 2]},
        {"mesh": 0, "rotation": np.roll(turn, -1).tolist(), "scale": [2, 2, 2], "translation": [1, 2, 3]},
        {"scale": [2, 2, 2], "translation": [1, 2, 3], "children": [3]},
        {"mesh": 1, "matrix": matrix.T.reshape(-1).tolist()},
    ]
    both = {f"{name}{i}": values for i in "01" for name, values in attributes_of(gaussians).items()}
    document = save_glb(tmp_path / "a.glb", both, nodes)
    (primitive,) = document["meshes"][0]["primitives"]
    parts = [{name[:-1]: at for name, at in primitive["attributes"].items() if name[-1] == i} for i in "01"]
    document["meshes"] = [{"primitives": [primitive | {"attributes": part}]} for part in parts]
    content = (tmp_path / "a.glb").read_bytes()[-document["buffers"][0]["byteLength"] :]
    write_document(tmp_path / "a.glb", document, content)
    actual = read_gaussians(tmp_path / "a.glb").gaussians
    count = len(gaussians)
    means = (2 * gaussians.means @ matrix[:3, :3].T + [1, 2, 3]) * [-1, -1, 1]
    assert_same_gaussians(actual[:count], actual[count:])
    np.testing.assert_allclose(actual.means[:count], means, atol=1e-5)
    np.testing.assert_allclose(actual.scales[:count], 2 * gaussians.scales, rtol=1e-5)


def test_quantised_values_of_a_glb_are_read(scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, 0)
    columns = attributes_of(gaussians)
    save_glb(tmp_path / "plain.glb", columns)
    expected = read_gaussians(tmp_path / "plain.glb").gaussians
    columns[f"{NAME}:ROTATION"] = np.round(127 * columns[f"{NAME}:ROTATION"]).astype(np.int8)
    columns[f"{NAME}:SCALE"] = np.round(65535 * columns[f"{NAME}:SCALE"].clip(0, 1)).astype(np.uint16)
    columns[f"{NAME}:OPACITY"] = np.round(255 * columns[f"{NAME}:OPACITY"]).astype(np.uint8)
    save_glb(tmp_path / "small.glb", columns)
    actual = read_gaussians(tmp_path / "small.glb").gaussians
    assert np.abs((actual.quats * expected.quats).sum(1)).min() > 0.9998
    np.testing.assert_allclose(actual.scales, expected.scales.clip(0, 1), atol=1 / 65535)
    np.testing.assert_allclose(actual.opacities, expected.opacities, atol=0.5 / 255 + 1e-6)


def test_a_glb_is_known_to_hold_gaussians_by_its_extension(scene: Scene, tmp_path: Path) -> None:
    document = save_glb(tmp_path / "a.glb", attributes_of(drawn(scene, 0)))
    assert holds_gaussians(tmp_path / "a.glb")
    document["extensionsUsed"] = []
    write_document(tmp_path / "a.glb", document, b"")
    assert not holds_gaussians(tmp_path / "a.glb")
    (tmp_path / "a.glb").write_bytes(b"glTF")
    assert holds_gaussians(tmp_path / "a.glb")  # its reader says what is wrong with it


@pytest.mark.parametrize(("num_more", "is_doubtful"), [(3, False), (12, True)])
def test_more_than_padding_beyond_the_stated_length_of_a_glb_is_a_doubt(
    scene: Scene, tmp_path: Path, num_more: int, is_doubtful: bool
) -> None:
    write_gaussians(tmp_path / "a.glb", scene.gaussians)
    with (tmp_path / "a.glb").open("ab") as file:
        file.write(bytes(num_more))
    doubts = list_doubts(file_notes(read_gaussians(tmp_path / "a.glb").info))
    assert [doubt.startswith("12 bytes follow") for doubt in doubts] == [True] * is_doubtful


def test_a_viewers_first_picture_is_that_of_the_middle_view(scene: Scene, tmp_path: Path) -> None:
    """A camera node projects points as the view does, whose pixels are those of a picture of glTF's camera."""
    path = tmp_path / "a.glb"
    write_scene(path, scene)
    document, _ = read_document(path)
    nodes = [node for node in document["nodes"] if "camera" in node]
    assert [node["name"] for node in nodes] == [scene.names[view] for view in order_views(scene.cameras)]
    view, lens = order_views(scene.cameras)[0], document["cameras"][nodes[0]["camera"]]["perspective"]
    assert view == 1
    shown = read_gaussians(path).gaussians.means[::50].astype(np.float64) * (-1, -1, 1)  # to the frame of the file
    pose = np.reshape(nodes[0]["matrix"], (4, 4)).T
    x, y, z = (np.linalg.inv(pose) @ np.column_stack([shown, np.ones(len(shown))]).T)[:3]
    focal = float(cos(np.array(lens["yfov"] / 2)) / sin(np.array(lens["yfov"] / 2)))
    ndc = np.stack([focal / lens["aspectRatio"] * x / -z, focal * y / -z], 1)
    width, height = scene.cameras.width, scene.cameras.height
    pixels = project(scene.gaussians.means[::50].astype(np.float64), scene.cameras)[0][view]
    np.testing.assert_allclose((1 + ndc * (1, -1)) / 2 * (width, height), pixels, atol=1e-2)


def read_document(path: Path) -> tuple[Document, int]:
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length]), length


@pytest.mark.parametrize("ending", [".glb", ".sog"])
def test_viewers_of_a_scene_without_cameras_start_at_a_placed_one(ending: str, scene: Scene, tmp_path: Path) -> None:
    """It sees the scene, and it is not written as if it were a photo's."""
    path = tmp_path / f"a{ending}"
    write_scene(path, replace(scene, cameras=scene.cameras[:0], names=(), pixels=None, images=None))
    assert not path.with_name("a.cameras.json").exists()
    if ending == ".glb":
        (node,) = (node for node in read_document(path)[0]["nodes"] if "camera" in node)
        pose = np.reshape(node["matrix"], (4, 4)).T
        position, forward = pose[:3, 3] * (-1, -1, 1), -pose[:3, 2] * (-1, -1, 1)
    else:
        (camera,) = json.loads(path.with_name("a.settings.json").read_text())["cameras"]
        position, target = (np.array(camera["initial"][name]) * (-1, -1, 1) for name in ("position", "target"))
        forward = target - position
    assert float(((scene.gaussians.means - position) @ forward > 0).mean()) > 0.9


def test_settings_start_a_viewer_at_the_middle_view(scene: Scene, tmp_path: Path) -> None:
    path, settings = tmp_path / "a.sog", tmp_path / "a.settings.json"
    write_scene(path, scene)
    (camera,) = json.loads(settings.read_text())["cameras"]
    view = order_views(scene.cameras)[0]
    position, target = (np.array(camera["initial"][name]) * (-1, -1, 1) for name in ("position", "target"))
    np.testing.assert_allclose(position, scene.cameras.centres[view])
    pixel = project(target[None], scene.cameras)[0][view][0]
    np.testing.assert_allclose(pixel, (scene.cameras.width / 2, scene.cameras.height / 2), atol=1e-6)
    tangent = sin(np.radians(camera["initial"]["fov"] / 2)) / cos(np.radians(camera["initial"]["fov"] / 2))
    assert tangent == pytest.approx(scene.cameras.width / 2 / scene.cameras.Ks[view, 0, 0], rel=1e-5)  # the longer side
    document = json.loads(settings.read_text())
    (track,) = document["animTracks"]  # without one the viewer would turn by itself
    assert document["startMode"] == "animTrack"
    assert track["keyframes"]["values"]["position"] == 2 * camera["initial"]["position"]
    settings.write_text(settings.read_text().replace("60", "61"))  # of an earlier result
    write_scene(path, scene, overwrite=True)
    assert json.loads(settings.read_text()) == document
    path.unlink()
    path.with_name("a.cameras.json").unlink()
    write_scene(path, scene)  # beside settings that stay


def test_settings_of_a_user_beside_a_sog_stay(scene: Scene, tmp_path: Path) -> None:
    path, settings = tmp_path / "a.sog", tmp_path / "a.settings.json"
    write_scene(path, scene)
    settings.write_text("{}")
    write_scene(path, scene, overwrite=True)
    assert settings.read_text() == "{}"


def test_many_small_parts_share_the_memory_of_one_file(tmp_path: Path) -> None:
    """Each part, a gzip of zeros, is small enough by itself."""
    part = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 400_000, 0, 12, 0, 0) + bytes(400_000 * 20), 9)
    part += bytes(-len(part) % 4)
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitives = [
        {"attributes": {}, "mode": 0,
         "extensions": {NAME: splats | {"extensions": {f"{NAME}_compression_spz_2": {"bufferView": view}}}}}
        for view in range(3)
    ]  # fmt: skip
    views = [{"buffer": 0, "byteOffset": view * len(part), "byteLength": len(part)} for view in range(3)]
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}], "bufferViews": views, "buffers": [{"byteLength": 3 * len(part)}],
        "extensionsUsed": [NAME],
    }  # fmt: skip
    write_document(tmp_path / "a.glb", document, 3 * part)
    with refuses(SceneError, "a.glb", "64 MB", f"{(tmp_path / 'a.glb').stat().st_size:,} bytes"):
        read_gaussians(tmp_path / "a.glb")
    write_document(tmp_path / "b.glb", document | {"meshes": [{"primitives": primitives[:1]}]}, 3 * part)
    with refuses(SceneError, "b.glb", "400,000 rows at the origin"):  # a part is read by itself
        read_gaussians(tmp_path / "b.glb")


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
