"""Slow, obvious readers, and splat-transform where it is installed, read back what is written."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from former_formats import compressed_bytes
from messages import noted, refuses
from plyfile import PlyData
from slow_readers import corners, drawn, read_back
from splat_transform_programs import needs_program
from sweeps import sweep
from tiny_scene import Tiny

from gsmerge import Scene
from gsmerge.errors import SceneError, UsageError
from gsmerge.io import OUTPUT_FORMATS, limit_notes, output_format, read_ply, write_gaussians, write_ply
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.method.geometry.transforms import normalize
from gsmerge.method.kernels import elementary
from gsmerge.settings.setting import join_words
from gsmerge.types import Gaussians

QUANTISED = (".spz", ".sog", ".splat")


# dB between a render of the .ply and one of the file, of Gaussians with every parameter drawn at random; with rows in
# another order alone, as in .compressed.ply and .sog, 44 of degree 0 and 37 of degree 3
FLOORS = {(".spz", 0): 48, (".splat", 0): 48, (".sog", 0): 42, (".spz", 3): 32, (".sog", 3): 35}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, 96, 72))


def psnr(scene: Scene, one: Gaussians, other: Gaussians) -> float:
    a, b = (scenes.images_of(g, scene.cameras)[0].clip(0, 1) for g in (one, other))
    return float(-10 * elementary.log10(max(((a - b) ** 2).mean(), 1e-12)))


@pytest.mark.parametrize(("ending", "degree"), FLOORS)
def test_a_file_that_is_read_back_shows_the_same(ending: str, degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians, path = drawn(scene, degree), tmp_path / f"a{ending}"
    write_gaussians(path, gaussians)
    actual = read_back(path)
    assert (len(actual), actual.sh_degree) == (len(gaussians), degree)
    assert psnr(scene, gaussians, actual) > FLOORS[ending, degree]


def test_a_compressed_ply_is_read_and_not_written(scene: Scene, tmp_path: Path) -> None:
    gaussians, path = drawn(scene, 3), tmp_path / "a.compressed.ply"
    path.write_bytes(compressed_bytes(gaussians, ["SplatRenderMode: mip"]))
    actual = read_ply(path)
    assert (actual.info.layout, actual.info.comments) == ("compressed, SH degree 3", ("SplatRenderMode: mip",))
    assert psnr(scene, gaussians, actual.gaussians) > 34
    for name in ("b.compressed.ply", "B.USDA"):
        with refuses(UsageError, name, "a name that ends in", ".glb"):
            write_gaussians(tmp_path / name, gaussians)
    assert [one.name for one in tmp_path.iterdir()] == ["a.compressed.ply"]


@needs_program()
@pytest.mark.parametrize(("ending", "degree"), FLOORS)
def test_splat_transform_reads_what_our_readers_read(ending: str, degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians, path, back = drawn(scene, degree), tmp_path / f"a{ending}", tmp_path / "back.ply"
    write_gaussians(path, gaussians)
    subprocess.run([find_program(), "-q", str(path), str(back)], check=True, capture_output=True)
    actual = read_ply(back).gaussians
    assert (len(actual), actual.sh_degree) == (len(gaussians), degree)
    assert psnr(scene, gaussians, actual) > FLOORS[ending, degree]
    assert psnr(scene, read_back(path), actual) > 50  # of .splat, it takes 127.5 for the middle


@sweep("ending", OUTPUT_FORMATS, often=4)
def test_the_same_gaussians_give_the_same_bytes(ending: str, scene: Scene, tmp_path: Path) -> None:
    for name in "ab":
        write_gaussians(tmp_path / f"{name}{ending}", drawn(scene, 0))
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()


@pytest.mark.parametrize("ending", [".ply", *QUANTISED])
def test_extremes_are_read_back_as_finite_numbers(ending: str, tmp_path: Path) -> None:
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
    assert float(cosines.min()) > {".splat": 0.9998, ".sog": 0.9998, ".spz": 0.99999}[ending]
    assert float(np.abs(actual.means - means).max()) < 0.5


def test_harmonics_that_a_format_cannot_store_are_noted() -> None:
    assert limit_notes("a.ply", 3, 1) == []
    assert noted(limit_notes("a.ply", 4, 1), "above degree 3", ".ply")
    assert limit_notes("a.spz", 3, 1) == []
    (note,) = limit_notes("a.splat", 1, 1)
    assert note == "harmonics above degree 0, which .splat cannot store, are left out"
    assert noted(limit_notes("a.SPZ", 4, 1), "above degree 3")


def test_more_gaussians_than_readers_take_are_noted() -> None:
    assert limit_notes("a.spz", 0, 10_000_000) == limit_notes("a.ply", 0, 10**9) == []
    assert noted(limit_notes("a.spz", 0, 10_000_001), "10,000,000", ".sog")


@pytest.mark.parametrize(("ending", "degree"), [(".ply", 3), (".spz", 3), (".sog", 3), (".splat", 0)])
def test_harmonics_above_the_degree_of_a_format_are_left_out(
    ending: str, degree: int, scene: Scene, tmp_path: Path
) -> None:
    write_gaussians(tmp_path / f"a{ending}", drawn(scene, 4))
    assert read_back(tmp_path / f"a{ending}").sh_degree == degree


def test_the_file_name_chooses_the_format() -> None:
    for name, ending in (("a.ply", ".ply"), ("A.SPZ", ".spz"), ("x/b.splat", ".splat")):
        assert output_format(name, alone=True).ending == ending
    for name in ("a", "a.ksplat", "ply", "a.ply.gz", "spz/a"):
        with refuses(UsageError, name, join_words(OUTPUT_FORMATS)):
            output_format(name, alone=True)


@pytest.mark.parametrize("ending", OUTPUT_FORMATS)
def test_failures_leave_only_existing_files(ending: str, tmp_path: Path) -> None:
    bad, path = replace(corners(), opacities=np.array([0.0, float("nan"), 0.5], np.float32)), tmp_path / f"a{ending}"
    with refuses(ValueError, "", "finite", 1):
        write_gaussians(path, bad)
    with refuses(ValueError, "gaussians", "none"):
        write_gaussians(path, corners()[:0])
    assert list(tmp_path.iterdir()) == []
    path.write_text("precious")
    with refuses(SceneError, path, "exists"):
        write_gaussians(path, corners())
    with refuses(ValueError, "", "finite", 1):
        write_gaussians(path, bad, overwrite=True)
    assert [one.read_text() for one in tmp_path.iterdir()] == ["precious"]


def test_comments_are_written_into_the_header(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", corners(), comments=["SplatRenderMode: mip"])
    assert "SplatRenderMode: mip" in read_ply(tmp_path / "a.ply").info.comments


def test_a_comment_of_two_lines_is_refused(tmp_path: Path) -> None:
    with refuses(ValueError, "comments", "ASCII"):
        write_gaussians(tmp_path / "b.spz", corners(), comments=["two\nlines"])


def test_more_comments_than_readers_take_are_refused(tmp_path: Path) -> None:
    lines = ["gsmerge cameras: " + "A" * 900] * 500
    write_gaussians(tmp_path / "a.ply", corners(), comments=lines)
    assert len(read_ply(tmp_path / "a.ply").gaussians) == len(corners())
    with refuses(ValueError, "comments", "524,288"):
        write_gaussians(tmp_path / "b.ply", corners(), comments=2 * lines)


def test_a_ply_without_normals_saves_twelve_bytes_a_gaussian(scene: Scene, tmp_path: Path) -> None:
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


def with_harmonics(gaussians: Gaussians, degree: int) -> Gaussians:
    shN = np.random.default_rng(0).normal(size=(len(gaussians), (degree + 1) ** 2 - 1, 3))
    return replace(gaussians, shN=shN.astype(np.float32))


def test_the_layout_of_a_ply_is_that_of_inria(tmp_path: Path, tiny: Tiny) -> None:
    gaussians = with_harmonics(tiny.gaussians, 1)
    write_ply(tmp_path / "a.ply", gaussians)
    data = PlyData.read(str(tmp_path / "a.ply"))
    vertex = data["vertex"]
    assert (data.text, data.byte_order) == (False, "<")
    assert [p.name for p in vertex.properties] == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(9)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    assert vertex["f_rest_4"].tolist() == gaussians.shN[:, 1, 1].tolist()
    assert np.allclose(vertex["scale_2"], np.log(gaussians.scales[:, 2]), atol=1e-6)
    opacities = gaussians.opacities.astype(np.float64)
    assert np.allclose(vertex["opacity"], np.log(opacities / (1 - opacities)), atol=1e-6)
    assert not vertex["nx"].any()


def test_tensors_are_written_as_arrays_are(tmp_path: Path, tiny: Tiny, torch: object) -> None:
    write_ply(tmp_path / "a.ply", tiny.gaussians)
    tensors = tiny.gaussians.to("cpu")
    write_ply(tmp_path / "b.ply", replace(tensors, means=tensors.means.clone().requires_grad_()))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_harmonics_are_dropped_on_demand(tmp_path: Path, tiny: Tiny) -> None:
    gaussians = with_harmonics(tiny.gaussians, 3)
    write_ply(tmp_path / "a.ply", gaussians, sh_degree=1)
    assert np.array_equal(read_ply(tmp_path / "a.ply").gaussians.shN, gaussians.shN[:, :3])
    write_ply(tmp_path / "b.ply", gaussians, sh_degree=0)
    assert read_ply(tmp_path / "b.ply").info.layout == "17-column export"


def test_a_degree_above_that_of_the_gaussians_is_refused(tmp_path: Path, tiny: Tiny) -> None:
    with refuses(ValueError, "sh_degree", "0 to 3", 4):
        write_ply(tmp_path / "c.ply", with_harmonics(tiny.gaussians, 3), sh_degree=4)


def test_extremes_are_stored_as_finite_numbers(tmp_path: Path, tiny: Tiny) -> None:
    few = tiny.gaussians[:3]
    extreme = replace(
        few,
        opacities=np.array([0.0, 1.0, 0.5], np.float32),
        scales=np.array([[0.1, 0.1, 0.0], [1e-38, 1e30, 1.0], [1.0, 1.0, 1.0]], np.float32),
        quats=np.array([[0.0, 0, 0, 0], [2, 0, 0, 0], [0, 0, -3, 4]], np.float32),
    )
    write_ply(tmp_path / "a.ply", extreme)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    assert all(np.isfinite(rows[name]).all() for name in rows.dtype.names)
    back = read_ply(tmp_path / "a.ply").gaussians
    assert back.opacities.tolist() == pytest.approx([0, 1, 0.5], abs=2e-7)
    assert ((back.opacities > 0) & (back.opacities < 1)).all()
    assert (back.scales > 0).all()
    assert back.quats[0].tolist() == [1, 0, 0, 0]
    assert back.quats[2].tolist() == pytest.approx([0, 0, -0.6, 0.8], abs=1e-6)


def test_values_that_are_impossible_are_not_written(tmp_path: Path, tiny: Tiny) -> None:
    odd = dict.fromkeys(("means", "scales", "opacities", "sh0", "quats"), np.nan)
    for field, value in [*odd.items(), ("opacities", 1.5), ("scales", -1.0)]:
        values = getattr(tiny.gaussians, field).copy()
        values[5] = value
        with refuses(ValueError, "", "finite"):
            write_ply(tmp_path / "a.ply", replace(tiny.gaussians, **{field: values}))
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [*QUANTISED, ".SPZ"])
def test_a_ply_under_the_name_of_another_format_is_refused(ending: str, scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.ply.*write_gaussians"):
        write_ply(tmp_path / f"a{ending}", scene.gaussians)
    write_ply(tmp_path / "a", scene.gaussians)
    write_gaussians(tmp_path / "b.spz", scene.gaussians, ending=".ply")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b.spz").read_bytes()
