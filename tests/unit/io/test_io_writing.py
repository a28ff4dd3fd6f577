"""Formats beside .ply: each against a slow, obvious reader, and against splat-transform where that is installed."""

from __future__ import annotations

import gzip
import json
import struct
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.baselines.splat_transform import find_program
from gsmerge.errors import SceneError, UsageError
from gsmerge.geometry import normalize
from gsmerge.io import OUTPUT_FORMATS, lost_harmonics, output_format, read_gaussians, read_ply, write_gaussians
from gsmerge.types import SH_C0

QUANTISED = (".compressed.ply", ".spz", ".sog", ".splat")
# dB between a render of the .ply and one of the file, of Gaussians with every parameter drawn at random; with rows in
# another order alone, as in .compressed.ply and .sog, 44 of degree 0 and 37 of degree 3
FLOORS = {
    (".compressed.ply", 0): 40, (".spz", 0): 48, (".splat", 0): 48, (".sog", 0): 42,
    (".compressed.ply", 3): 34, (".spz", 3): 32, (".sog", 3): 35,
}  # fmt: skip


def program() -> str | None:
    try:
        return find_program()
    except UsageError:
        return None


needs_program = pytest.mark.skipif(program() is None, reason="needs splat-transform")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 96, 72))


def drawn(scene: Scene, degree: int) -> Gaussians:
    """Merged Gaussians with random rotations, sizes and harmonics."""
    rng = np.random.default_rng(degree)
    g = scenes.plain(scene, superpixels="10%")
    quats = normalize(rng.normal(size=g.quats.shape).astype(np.float32))
    shN = rng.normal(0, 0.1, (len(g), (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    scales = g.scales * rng.uniform(0.5, 1.5, g.scales.shape).astype(np.float32)
    return replace(g, means=g.means.astype(np.float32), quats=quats, scales=scales, shN=shN)


def psnr(scene: Scene, one: Gaussians, other: Gaussians) -> float:
    a, b = (scenes.images_of(g, scene.cameras)[0].clip(0, 1) for g in (one, other))
    return float(-10 * np.log10(max(((a - b) ** 2).mean(), 1e-12)))


def arrays(*columns: np.ndarray, harmonics: np.ndarray) -> Gaussians:
    means, quats, scales, opacities, colors = (np.asarray(c, np.float32) for c in columns)
    quats = normalize(quats)
    return Gaussians(means, quats, scales, opacities, ((colors - 0.5) / SH_C0)[:, None], harmonics)


def read_splat(path: Path) -> Gaussians:
    data, rows = path.read_bytes(), []
    for start in range(0, len(data), 32):
        values = struct.unpack_from("<6f8B", data, start)
        rows.append([*values[:6], *(v / 255 for v in values[6:10]), *((v - 128) / 128 for v in values[10:])])
    table = np.array(rows, np.float32)
    none = np.zeros((len(table), 0, 3), np.float32)
    return arrays(table[:, :3], table[:, 10:], table[:, 3:6], table[:, 9], table[:, 6:9], harmonics=none)


def read_spz(path: Path) -> Gaussians:
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, fraction, flags, reserved = struct.unpack_from("<3I4B", data)
    assert (magic, version, flags, reserved) == (0x5053474E, 3, 0, 0)
    at, num_higher = 16, (degree + 1) ** 2 - 1

    def take(each: int) -> list[bytes]:
        nonlocal at
        rows = [data[at + i * each : at + (i + 1) * each] for i in range(count)]
        at += count * each
        return rows

    means = [[int.from_bytes(r[i : i + 3], "little", signed=True) / 2**fraction for i in (0, 3, 6)] for r in take(9)]
    opacities = [r[0] / 255 for r in take(1)]
    colors = [[0.5 + SH_C0 * (v / 255 - 0.5) / 0.15 for v in r] for r in take(3)]
    scales = [[np.exp(v / 16 - 10) for v in r] for r in take(3)]
    quats = []
    for row in take(4):
        word = int.from_bytes(row, "little")
        quat, largest = [0.0] * 4, word >> 30
        for i in reversed([i for i in range(4) if i != largest]):
            quat[i] = (-1 if word >> 9 & 1 else 1) * (word & 511) / 511 / np.sqrt(2)
            word >>= 10
        quat[largest] = np.sqrt(max(0.0, 1 - sum(v * v for v in quat)))
        quats.append([quat[3], *quat[:3]])
    harmonics = np.array([[(v - 128) / 128 for v in r] for r in take(3 * num_higher)], np.float32)
    assert at == len(data)
    harmonics = harmonics.reshape(count, num_higher, 3)
    return arrays(*map(np.array, (means, quats, scales, opacities, colors)), harmonics=harmonics)


def read_back(path: Path) -> Gaussians:
    return {".spz": read_spz, ".splat": read_splat}.get(path.suffix, lambda p: read_gaussians(p).gaussians)(path)


@pytest.mark.parametrize(("ending", "degree"), FLOORS)
def test_what_is_read_back_shows_the_same(ending: str, degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians, path = drawn(scene, degree), tmp_path / f"a{ending}"
    write_gaussians(path, gaussians)
    actual = read_back(path)
    assert (len(actual), actual.sh_degree) == (len(gaussians), degree)
    assert psnr(scene, gaussians, actual) > FLOORS[ending, degree]


@needs_program
@pytest.mark.parametrize(("ending", "degree"), FLOORS)
def test_splat_transform_reads_the_same(ending: str, degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians, path, back = drawn(scene, degree), tmp_path / f"a{ending}", tmp_path / "back.ply"
    write_gaussians(path, gaussians)
    subprocess.run([str(program()), "-q", str(path), str(back)], check=True, capture_output=True)
    actual = read_ply(back).gaussians
    assert (len(actual), actual.sh_degree) == (len(gaussians), degree)
    assert psnr(scene, gaussians, actual) > FLOORS[ending, degree]
    assert psnr(scene, read_back(path), actual) > 50  # of .splat, it takes 127.5 for the middle


@pytest.mark.parametrize("ending", QUANTISED)
def test_they_are_smaller(ending: str, scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, 0)
    write_gaussians(tmp_path / "a.ply", gaussians)
    write_gaussians(tmp_path / f"b{ending}", gaussians)
    assert (tmp_path / f"b{ending}").stat().st_size < (tmp_path / "a.ply").stat().st_size / 2


@pytest.mark.parametrize("ending", OUTPUT_FORMATS)
def test_the_same_gaussians_give_the_same_bytes(ending: str, scene: Scene, tmp_path: Path) -> None:
    for name in "ab":
        write_gaussians(tmp_path / f"{name}{ending}", drawn(scene, 0))
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()


def corners() -> Gaussians:
    """Opacities of 0 and 1, scales of 0, colours beyond the range, one coordinate far away, a zero quaternion."""
    return Gaussians(
        means=np.array([[0.0, 0, 0], [1e5, -3, 2], [-7, 1e-8, 0.5]], np.float32),
        quats=np.array([[0.0, 0, 0, 0], [-0.6, 0, 0.8, 0], [0, 0, 0, -1.0]], np.float32),
        scales=np.array([[0.0, 1e-9, 1], [1e3, 1, 1], [0.01, 0.02, 0.03]], np.float32),
        opacities=np.array([0.0, 1.0, 0.5], np.float32),
        sh0=np.array([[[-9.0, 0, 9]], [[1, 2, 3]], [[0, 0, 0]]], np.float32),
        shN=np.zeros((3, 0, 3), np.float32),
    )


@pytest.mark.parametrize("ending", [".ply", *QUANTISED])
def test_extremes_stay_finite(ending: str, tmp_path: Path) -> None:
    write_gaussians(tmp_path / f"a{ending}", corners())
    actual = read_back(tmp_path / f"a{ending}")
    for name, array in vars(actual).items():
        assert np.isfinite(array).all(), name
    assert sorted(actual.opacities.round(1).tolist()) == [0.0, 0.5, 1.0]
    assert float(actual.means[:, 0].max()) == pytest.approx(1e5, rel=1e-3)


@pytest.mark.parametrize("ending", QUANTISED)
def test_rotations_are_the_same_up_to_a_sign(ending: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    quats = normalize(rng.normal(size=(300, 4)).astype(np.float32))
    n = len(quats)
    # along a line, so that rows keep their order along the curve through space
    means = np.repeat(np.arange(n, dtype=np.float32)[:, None], 3, 1)
    colors = np.zeros((n, 1, 3), np.float32)
    gaussians = Gaussians(means, quats, np.full_like(means, 0.1), np.full_like(means[:, 0], 0.5), colors, colors[:, :0])
    write_gaussians(tmp_path / f"a{ending}", gaussians)
    actual = read_back(tmp_path / f"a{ending}")
    cosines = np.abs((actual.quats * quats).sum(1))
    assert (
        float(cosines.min()) > {".splat": 0.9998, ".sog": 0.9998, ".spz": 0.99999, ".compressed.ply": 0.99999}[ending]
    )
    assert float(np.abs(actual.means - means).max()) < 0.5


def test_harmonics_without_room_are_noted() -> None:
    assert lost_harmonics("a.ply", 4) is None
    assert lost_harmonics("a.spz", 3) is None
    note = lost_harmonics("a.splat", 1)
    assert note == ".splat has no room for harmonics above degree 0: left out"
    assert "above degree 3" in str(lost_harmonics("a.COMPRESSED.ply", 4))


def test_a_higher_degree_loses_its_top(scene: Scene, tmp_path: Path) -> None:
    for ending, degree in ((".spz", 3), (".sog", 3), (".compressed.ply", 3), (".splat", 0)):
        write_gaussians(tmp_path / f"a{ending}", drawn(scene, 4))
        assert read_back(tmp_path / f"a{ending}").sh_degree == degree


@pytest.mark.parametrize(
    ("name", "ending"),
    [("a.ply", ".ply"), ("a.compressed.ply", ".compressed.ply"), ("A.SPZ", ".spz"), ("x/b.splat", ".splat")],
)
def test_names_ask_for_formats(name: str, ending: str) -> None:
    assert output_format(name) == ending


@pytest.mark.parametrize("name", ["a", "a.ksplat", "ply", "a.ply.gz", "spz/a"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(
        UsageError, match=r"expected a name that ends in \.compressed\.ply, \.ply, \.spz, \.sog, \.splat or \.glb"
    ):
        output_format(name)


@pytest.mark.parametrize("ending", OUTPUT_FORMATS)
def test_nan_is_refused_and_leaves_nothing(ending: str, tmp_path: Path) -> None:
    bad = replace(corners(), opacities=np.array([0.0, float("nan"), 0.5], np.float32))
    with pytest.raises(ValueError, match="expected finite Gaussians"):
        write_gaussians(tmp_path / f"a{ending}", bad)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", OUTPUT_FORMATS)
def test_existing_files_are_kept(ending: str, tmp_path: Path) -> None:
    (tmp_path / f"a{ending}").write_text("precious")
    with pytest.raises(SceneError, match="exists already"):
        write_gaussians(tmp_path / f"a{ending}", corners())
    assert (tmp_path / f"a{ending}").read_text() == "precious"


@pytest.mark.parametrize("ending", OUTPUT_FORMATS)
def test_no_gaussians(ending: str, tmp_path: Path) -> None:
    write_gaussians(tmp_path / f"a{ending}", corners()[:0])
    assert (tmp_path / f"a{ending}").exists()


def test_comments_reach_the_headers(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.compressed.ply", corners(), comments=["SplatRenderMode: mip"])
    assert "SplatRenderMode: mip" in read_ply(tmp_path / "a.compressed.ply").info.comments
    with pytest.raises(ValueError, match="printable lines of ASCII"):
        write_gaussians(tmp_path / "b.compressed.ply", corners(), comments=["two\nlines"])


def read_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The document of a binary glTF, and the attributes of its only primitive."""
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
        dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        values = np.frombuffer(content[view["byteOffset"] :][: view["byteLength"]], dtype)
        attributes[name] = values.reshape(accessor["count"], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]])
        assert view["byteOffset"] % 4 == 0
    return document, attributes


@pytest.mark.parametrize("degree", [0, 3])
def test_glb_holds_everything(degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, degree)
    write_gaussians(tmp_path / "a.glb", gaussians)
    document, actual = read_glb(tmp_path / "a.glb")
    prefix, n = "KHR_gaussian_splatting:", len(gaussians)
    np.testing.assert_array_equal(actual["POSITION"], gaussians.means)
    np.testing.assert_allclose(actual[f"{prefix}ROTATION"][:, [3, 0, 1, 2]], gaussians.quats, atol=1e-6)
    np.testing.assert_allclose(actual[f"{prefix}SCALE"], gaussians.scales, rtol=1e-5)
    np.testing.assert_allclose(actual[f"{prefix}OPACITY"][:, 0], gaussians.opacities)
    np.testing.assert_array_equal(actual[f"{prefix}SH_DEGREE_0_COEF_0"], gaussians.sh0[:, 0])
    places = [(d, i) for d in range(1, degree + 1) for i in range(2 * d + 1)]
    harmonics = [actual[f"{prefix}SH_DEGREE_{d}_COEF_{i}"] for d, i in places]
    np.testing.assert_array_equal(np.stack([np.zeros((n, 3)), *harmonics], 1)[:, 1:], gaussians.shN)
    assert len(actual) == 6 + len(places)
    assert actual["COLOR_0"].shape == (n, 4)
    low = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]["min"]
    np.testing.assert_array_equal(low, gaussians.means.min(0))
    assert document["nodes"][0]["rotation"] == [0, 0, 1, 0]  # y up


def test_no_normals_is_the_same_without_twelve_bytes(scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, 1)
    for name, normals in {"with": True, "without": False}.items():
        write_gaussians(tmp_path / f"{name}.ply", gaussians, normals=normals)
    wide, narrow = (read_ply(tmp_path / f"{name}.ply") for name in ("with", "without"))
    assert wide.info.layout == "INRIA, SH degree 1"
    assert narrow.info.layout == "INRIA, SH degree 1 (no normals)"
    line = len("property float nx\n")
    assert wide.info.file_bytes - narrow.info.file_bytes == 12 * len(gaussians) + 3 * line
    for name, array in vars(wide.gaussians).items():
        np.testing.assert_array_equal(getattr(narrow.gaussians, name), array)
