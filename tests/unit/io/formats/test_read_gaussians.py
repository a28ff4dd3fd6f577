"""Gaussians are read from PLY files of any layout, and from the other formats as slow readers do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import noted, refuses
from numpy.lib.recfunctions import repack_fields
from plyfile import PlyData, PlyElement
from slow_readers import drawn, read_splat, read_spz

from gsmerge.errors import SceneError, list_doubts
from gsmerge.io import kept_comments, read_gaussians, read_ply, write_gaussians, write_ply
from gsmerge.io.formats.ply import header_content
from gsmerge.io.formats.read_gaussians import file_notes, read_parts
from gsmerge.method.geometry.transforms import sh0_to_rgb
from gsmerge.method.kernels import elementary
from gsmerge.runtime.threads import use_threads
from gsmerge.types import SH_C0, Gaussians

NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def columns(count: int = 5, num_rest: int = 0, dtype: str = "<f4", names: tuple[str, ...] = NAMES) -> np.ndarray:
    rng = np.random.default_rng(0)
    rest = [f"f_rest_{i}" for i in range(num_rest)]
    rows = np.zeros(count, [(name, dtype) for name in (*names, *rest)])
    for name in rows.dtype.names:
        rows[name] = rng.uniform(-3, 3, count)
    return rows


def save(path: Path, rows: np.ndarray, *, text: bool = False, order: str = "<", before: tuple = (), **kw: list) -> Path:
    PlyData([*before, PlyElement.describe(rows, "vertex")], text=text, byte_order=order, **kw).write(str(path))
    return path


def test_stored_values_are_activated_as_by_hand(tmp_path: Path) -> None:
    rows = columns(2)
    rows["opacity"] = (0.0, 2.0)
    rows["scale_1"] = (0.0, elementary.log(0.25))
    for name, value in zip(("rot_0", "rot_1", "rot_2", "rot_3"), (0.0, 3.0, 0.0, 4.0), strict=True):
        rows[name] = value
    scene = read_ply(save(tmp_path / "a.ply", rows))
    gaussians = scene.gaussians
    assert gaussians.opacities.tolist() == pytest.approx([0.5, 1 / (1 + np.exp(-2.0))], abs=1e-6)
    assert gaussians.scales[:, 1].tolist() == pytest.approx([1.0, 0.25], abs=1e-6)
    assert gaussians.quats[0].tolist() == pytest.approx([0, 0.6, 0, 0.8], abs=1e-6)
    assert gaussians.sh0[:, 0, 2].tolist() == rows["f_dc_2"].tolist()
    assert gaussians.means.dtype == np.float32
    assert scene.valid.all()


def test_common_layouts_are_described_in_the_info(tmp_path: Path) -> None:
    info = read_ply(save(tmp_path / "a.ply", columns())).info
    assert (info.layout, info.format, info.count, info.sh_degree) == ("17-column export", "binary little-endian", 5, 0)
    assert info.opacity_encoding == "logit"
    assert info.file_bytes == (tmp_path / "a.ply").stat().st_size
    assert info.bytes_by_attribute == {
        "means": 60, "normals": 60, "sh0": 60, "opacities": 20, "scales": 60, "quats": 80,
    }  # fmt: skip
    assert info.columns == NAMES
    assert read_ply(save(tmp_path / "b.ply", columns(num_rest=45))).info.layout == "INRIA, SH degree 3"
    bare = tuple(name for name in NAMES if not name.startswith("n"))
    info = read_ply(save(tmp_path / "c.ply", columns(names=bare))).info
    assert info.layout == "14-column export (no normals)"


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_higher_harmonics_are_channel_major_in_the_file(tmp_path: Path, degree: int) -> None:
    higher = (degree + 1) ** 2 - 1
    rows = columns(3, 3 * higher)
    shN = read_ply(save(tmp_path / "a.ply", rows)).gaussians.shN
    assert shN.shape == (3, higher, 3)
    for channel in range(3):
        for j in range(higher):
            assert shN[:, j, channel].tolist() == rows[f"f_rest_{channel * higher + j}"].tolist()


def test_every_binary_and_text_form_reads_alike(tmp_path: Path) -> None:
    rows = columns(7, 9)
    expected = read_ply(save(tmp_path / "a.ply", rows)).gaussians
    swapped = rows.astype([(n, ">f4") for n in rows.dtype.names])
    double = rows.astype([(n, "<f8") for n in rows.dtype.names])
    for form, path in {
        "big": save(tmp_path / "b.ply", swapped, order=">"),
        "text": save(tmp_path / "t.ply", rows, text=True),
        "double": save(tmp_path / "d.ply", double),
    }.items():
        actual = read_ply(path)
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            a, b = getattr(actual.gaussians, name).astype(np.float64), getattr(expected, name).astype(np.float64)
            assert np.allclose(a, b, rtol=1e-6, atol=1e-7), (form, name)
    assert read_ply(tmp_path / "d.ply").gaussians.means.dtype == np.float64
    assert read_ply(tmp_path / "d.ply").gaussians.scales.dtype == np.float32
    assert read_ply(tmp_path / "b.ply").info.format == "binary big-endian"
    assert read_ply(tmp_path / "t.ply").info.format == "ascii"


def test_float64_positions_keep_their_digits(tmp_path: Path) -> None:
    rows = columns(2, dtype="<f8")
    rows["x"] = (5_000_000.125, 400_000.0625)
    assert read_ply(save(tmp_path / "a.ply", rows)).gaussians.means[:, 0].tolist() == [5_000_000.125, 400_000.0625]


def test_extra_columns_or_elements_do_not_change_what_is_read(tmp_path: Path) -> None:
    rows = columns(4)
    mixed = np.zeros(4, [("label", "u1"), *((n, "u1" if n == "nx" else "<f4") for n in NAMES), ("time", "<f8")])
    for name in NAMES:
        mixed[name] = rows[name] if name != "nx" else 0
    size = PlyElement.describe(np.array([(768,)], [("pixels", "<i4")]), "image_size")
    faces = np.empty(2, [("vertex_indices", object)])
    faces["vertex_indices"] = [np.array([0, 1, 2], "i4"), np.array([1, 2, 3, 0], "i4")]
    path = save(
        tmp_path / "a.ply", mixed, before=(size, PlyElement.describe(faces, "face")), comments=["made by a test"]
    )
    actual = read_ply(path)
    assert actual.info.extra_columns == ("label", "time")
    assert actual.info.extra_elements == ("image_size", "face")
    assert actual.info.bytes_by_attribute["extra"] == 4 * 9
    assert np.array_equal(actual.gaussians.means, read_ply(save(tmp_path / "b.ply", rows)).gaussians.means)


def test_activated_opacities_are_recognised(tmp_path: Path) -> None:
    rows = columns(3)
    rows["opacity"] = (0.0, 0.25, 1.0)
    path = save(tmp_path / "a.ply", rows)
    actual = read_ply(path)
    assert actual.info.opacity_encoding == "raw"
    assert actual.gaussians.opacities.tolist() == [0.0, 0.25, 1.0]
    forced = read_ply(path, opacity="logit")
    assert forced.info.opacity_encoding == "logit"
    assert forced.gaussians.opacities[0] == 0.5
    rows["opacity"] = (0.0, 0.25, 1.001)
    assert read_ply(save(tmp_path / "b.ply", rows)).info.opacity_encoding == "logit"
    assert read_ply(tmp_path / "b.ply", opacity="raw").gaussians.opacities.max() == 1
    with refuses(ValueError, "opacity", "linear"):
        read_ply(path, opacity="linear")


def test_opacities_are_recognised_by_their_distribution(tmp_path: Path) -> None:
    """Roundings above 1 and a damaged value change nothing; logits of which most lie in [0, 1] stay logits."""
    rng = np.random.default_rng(0)
    rows = columns(10_000)
    rows["opacity"] = rng.uniform(0, 1, 10_000)
    rows["opacity"][:50] = 1.0000001
    rows["opacity"][50] = 7
    rounded = read_ply(save(tmp_path / "a.ply", rows))
    assert rounded.info.opacity_encoding == "raw"
    assert rounded.gaussians.opacities.max() == 1
    np.testing.assert_array_equal(rounded.gaussians.opacities[51:], rows["opacity"][51:])
    assert any("--hint opacity=logit" in note for note in file_notes(rounded.info))
    rows["opacity"] = rng.normal(0.5, 0.22, 10_000)  # 2 % beyond
    assert read_ply(save(tmp_path / "b.ply", rows)).info.opacity_encoding == "logit"
    rows["opacity"] = rng.normal(0.5, 0.17, 10_000)  # .3 %, as many as near the ends
    assert read_ply(save(tmp_path / "c.ply", rows)).info.opacity_encoding == "logit"
    rows["opacity"] = 0
    for name in NAMES:
        rows[name][5:] = 0  # placeholders, which say nothing
    rows["opacity"][:5] = (-1, 3, 4, 0.5, 6)
    assert read_ply(save(tmp_path / "d.ply", rows)).info.opacity_encoding == "logit"


def test_scales_and_colours_are_recognised_by_their_distribution(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    plain = (*(name for name in NAMES if not name.startswith("f_dc")), "r", "g", "b")
    rows = columns(10_000, names=plain)
    for name in "rgb":
        rows[name] = rng.uniform(0, 1, 10_000)
    for name in ("scale_0", "scale_1", "scale_2"):
        rows[name] = rng.uniform(0.01, 0.1, 10_000)
        rows[name][:3] = -1e-9
    activated = read_ply(save(tmp_path / "a.ply", rows))
    assert any("linear" in note for note in file_notes(activated.info))
    np.testing.assert_allclose(activated.gaussians.scales[5:, 0], rows["scale_0"][5:], rtol=1e-5)
    for name in "rgb":
        rows[name] *= 255
    bright = read_ply(save(tmp_path / "b.ply", rows))
    assert any("0 to 255" in note for note in file_notes(bright.info))
    np.testing.assert_allclose(bright.gaussians.sh0[5:], activated.gaussians.sh0[5:], atol=1e-5)


@pytest.mark.parametrize("prefix", ["scalar_", "scalar_scal_"])
@pytest.mark.parametrize("text", [True, False])
def test_columns_with_a_prefix_of_cloudcompare_are_read(tmp_path: Path, prefix: str, text: bool) -> None:
    rows = columns(40, 9)
    expected = read_ply(save(tmp_path / "a.ply", rows)).gaussians
    renamed = rows.astype([(name if name in "xyz" else prefix + name, "<f4") for name in rows.dtype.names])
    more = np.zeros(40, [*renamed.dtype.descr, (f"{prefix}label", "<f4")])
    for name in renamed.dtype.names:
        more[name] = renamed[name]
    actual = read_ply(save(tmp_path / "b.ply", more, text=text))
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(actual.gaussians, name), getattr(expected, name), rtol=1e-5, atol=1e-6)
    assert actual.info.extra_columns == ("label",)
    assert noted(file_notes(actual.info), repr(prefix), "CloudCompare")
    assert header_content(tmp_path / "b.ply") == "Gaussians"
    with refuses(SceneError, tmp_path / "c.ply", "since this one has none"):
        read_ply(save(tmp_path / "c.ply", repack_fields(more[["x", "y", "z", f"{prefix}label"]])))


def test_the_encoding_of_our_own_files_is_never_guessed(tmp_path: Path) -> None:
    gaussians = read_ply(save(tmp_path / "a.ply", columns(3))).gaussians
    faint = Gaussians(*(getattr(gaussians, f) if f != "opacities" else np.full((3,), 0.6) for f in (
        "means", "quats", "scales", "opacities", "sh0", "shN",
    )))  # fmt: skip
    write_ply(tmp_path / "b.ply", faint)  # all logits are 0.405: inside [0, 1]
    actual = read_ply(tmp_path / "b.ply")
    assert actual.info.opacity_encoding == "logit"
    assert actual.gaussians.opacities.tolist() == pytest.approx([0.6] * 3, abs=1e-6)


def test_infinite_logits_are_opacities_of_zero_or_one(tmp_path: Path) -> None:
    rows = columns(3)
    rows["opacity"] = (np.inf, -np.inf, 0.0)
    actual = read_ply(save(tmp_path / "a.ply", rows), opacity="logit")
    assert actual.gaussians.opacities.tolist() == [1.0, 0.0, 0.5]
    assert actual.valid.all()
    assert actual.info.num_nonfinite == 0
    rows["opacity"] = (np.inf, -np.inf, -np.inf)
    assert read_ply(save(tmp_path / "b.ply", rows)).info.opacity_encoding == "logit"


@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_4", "opacity", "scale_2", "rot_0"])
def test_a_row_with_nan_is_set_aside_in_place(tmp_path: Path, name: str) -> None:
    rows = columns(4, 9)
    rows[name][2] = np.nan
    actual = read_ply(save(tmp_path / "a.ply", rows))
    assert actual.valid.tolist() == [True, True, False, True]
    assert actual.info.num_nonfinite == 1
    one = actual.gaussians[2:3]
    assert one.opacities.item() == 0
    assert one.quats.tolist() == [[1, 0, 0, 0]]
    assert one.means.tolist() == actual.gaussians.means[1:2].tolist()
    assert all(np.isfinite(getattr(actual.gaussians, f)).all() for f in ("means", "quats", "scales", "sh0", "shN"))
    assert actual.gaussians.means[3].tolist() == [rows[c][3] for c in "xyz"]


def test_rows_with_infinite_values_are_set_aside(tmp_path: Path) -> None:
    rows = columns(3)
    rows["y"][0] = -np.inf
    rows["scale_0"][2] = np.inf
    actual = read_ply(save(tmp_path / "a.ply", rows))
    assert actual.valid.tolist() == [False, True, False]
    assert actual.gaussians.means[0].tolist() == actual.gaussians.means[1].tolist()


def test_rows_with_numbers_that_no_scene_has_are_set_aside(tmp_path: Path) -> None:
    rows = columns(6)
    rows["scale_0"] = (40, -40, 1, -np.inf, 1, 1)
    rows["scale_1"][0] = 50
    rows["f_dc_0"][4] = rows["f_dc_1"][4] = 3e38  # as float32, their sum is infinite
    actual = read_ply(save(tmp_path / "a.ply", rows))
    assert actual.valid.tolist() == [False, True, True, True, False, True]
    assert actual.info.num_nonfinite == 2
    assert np.isfinite(actual.gaussians.scales).all()
    assert (actual.gaussians.scales**2 > 0).all()
    assert actual.gaussians.scales[1, 0].item() == pytest.approx(np.exp(-30.0), rel=1e-5)


@pytest.mark.parametrize(
    ("factor", "stored", "part"),
    [
        (1.0, elementary.log, ""),
        (500.0, elementary.log, ""),  # millimetres: no logarithm is negative
        (100.0, np.positive, "read as linear"),
        (1.0, np.positive, "read as linear"),
        (1.0, lambda scales: elementary.log(1000 * scales), "too large"),
    ],
)
def test_scales_that_are_no_logarithms_or_too_large_are_noted(
    tmp_path: Path, factor: float, stored: Callable[[np.ndarray], np.ndarray], part: str
) -> None:
    rng = np.random.default_rng(0)
    rows = columns(1152)
    for name in ("x", "y", "z"):
        rows[name] = factor * rng.uniform(-1, 1, len(rows))
    for axis in range(3):
        rows[f"scale_{axis}"] = stored(factor * rng.uniform(0.01, 0.09, len(rows)))
    notes = [note for note in file_notes(read_ply(save(tmp_path / "a.ply", rows)).info) if "scale" in note]
    assert [part in note for note in notes] == [True] * bool(part)


@pytest.mark.parametrize(
    ("black", "white", "with_bytes", "is_rgb"),
    [(0, 1, False, True), (-0.5, 0.5, False, True), (0, 255, False, True), (0, 1, True, True), (0.1, 0.4, True, False),
     (0.1, 0.4, False, False), (-1.7, 1.7, False, False), (-1.7, 1.7, True, False)],
)  # fmt: skip
def test_rgb_in_the_place_of_harmonics_is_recognised(
    tmp_path: Path, black: float, white: float, with_bytes: bool, is_rgb: bool
) -> None:
    """By where all values end; few colours, and colours darker than grey, are those of harmonics."""
    rng = np.random.default_rng(0)
    rgb, rows = rng.random((2000, 3)).astype(np.float32), columns(2000)
    for channel in range(3):
        rows[f"f_dc_{channel}"] = black + (white - black) * rgb[:, channel]
    if with_bytes:
        more = np.empty(len(rows), [*rows.dtype.descr, *((name, "u1") for name in ("red", "green", "blue"))])
        for name in rows.dtype.names:
            more[name] = rows[name]
        for channel, name in enumerate(("red", "green", "blue")):
            more[name] = np.round(255 * rgb[:, channel])
        rows = more
    stored = np.stack([rows[f"f_dc_{channel}"] for channel in range(3)], 1)
    read = read_ply(save(tmp_path / "a.ply", rows))
    assert noted(file_notes(read.info), "--hint colors=sh") == is_rgb
    assert np.allclose(read.gaussians.sh0[:, 0], (rgb - 0.5) / SH_C0 if is_rgb else stored, atol=1e-4)
    kept = read_ply(tmp_path / "a.ply", colors="sh")
    assert np.array_equal(kept.gaussians.sh0[:, 0], stored)
    assert not noted(file_notes(kept.info), "f_dc")
    with refuses(ValueError, "colors", "raw"):
        read_ply(tmp_path / "a.ply", colors="raw")


@pytest.mark.parametrize("factor", [0.01, 1.0, 10.0])
def test_linear_scales_are_recognised_by_the_size_of_the_scene(tmp_path: Path, factor: float) -> None:
    """Logarithms of the same scales are kept in any unit."""
    rng = np.random.default_rng(0)
    rows = columns(40_000)
    for name in ("x", "y", "z"):
        rows[name] = factor * rng.uniform(-1, 1, len(rows))
    scales = factor * rng.lognormal(-5, 0.5, (len(rows), 3)).astype(np.float32)
    for axis in range(3):
        rows[f"scale_{axis}"] = scales[:, axis]
    linear = read_ply(save(tmp_path / "linear.ply", rows))
    np.testing.assert_allclose(linear.gaussians.scales, scales, rtol=1e-6)
    assert any("--hint scales=log" in note for note in file_notes(linear.info))
    kept = read_ply(tmp_path / "linear.ply", scales="log")
    np.testing.assert_allclose(kept.gaussians.scales, elementary.exp(scales), rtol=1e-6)
    for axis in range(3):
        rows[f"scale_{axis}"] = elementary.log(scales[:, axis])
    logs = read_ply(save(tmp_path / "log.ply", rows))
    np.testing.assert_allclose(logs.gaussians.scales, scales, rtol=1e-5)
    assert not any("scales" in note for note in file_notes(logs.info))


def test_scales_in_doubt_are_read_as_logarithms_with_a_note(tmp_path: Path) -> None:
    """Equal positive scales may be either; the note names the hint."""
    rng = np.random.default_rng(0)
    rows = columns(40_000)
    for name in ("x", "y", "z"):
        rows[name] = rng.uniform(0, 10, len(rows))
    for axis in range(3):
        rows[f"scale_{axis}"] = 0.05
    doubtful = read_ply(save(tmp_path / "a.ply", rows))
    np.testing.assert_allclose(doubtful.gaussians.scales, np.exp(0.05), rtol=1e-5)
    assert any("if they are linear, use --hint scales=linear" in note for note in file_notes(doubtful.info))
    stated = read_ply(tmp_path / "a.ply", scales="linear")
    np.testing.assert_allclose(stated.gaussians.scales, 0.05, rtol=1e-5)
    assert not any("scales" in note for note in file_notes(stated.info))
    rows["scale_0"] = -3
    with refuses(SceneError, "b.ply", "--hint scales=linear"):
        read_ply(save(tmp_path / "b.ply", rows), scales="linear")
    with refuses(ValueError, "scales", "raw"):
        read_ply(tmp_path / "a.ply", scales="raw")


def test_zero_or_extreme_quaternions_are_normalised(tmp_path: Path) -> None:
    rows = columns(5)
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        rows[name] = (0, 1e-30, 1e30, 2, -7)
    actual = read_ply(save(tmp_path / "a.ply", rows))
    assert actual.info.num_zero_quats == 1
    assert actual.gaussians.quats[0].tolist() == [1, 0, 0, 0]
    for i, sign in enumerate((1, 1, 1, -1), 1):
        assert actual.gaussians.quats[i].tolist() == pytest.approx([0.5 * sign] * 4, abs=1e-6)


def test_the_number_of_threads_does_not_change_what_is_read(tmp_path: Path) -> None:
    rows = columns(40_000, 9)
    rows["x"][::1000] = np.nan
    path = save(tmp_path / "a.ply", rows)
    results = []
    for count in (1, 2, 8):
        with use_threads(count):
            results.append(read_ply(path))
    for other in results[1:]:
        assert np.array_equal(other.valid, results[0].valid)
        assert other.info == results[0].info
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            assert np.array_equal(getattr(other.gaussians, name), getattr(results[0].gaussians, name))
    assert results[0].gaussians.means[39_999, 1].item() == rows["y"][39_999]
    assert results[0].info.num_nonfinite == 40


@pytest.mark.parametrize("text", [True, False])
def test_2d_gaussians_get_a_thin_third_scale(tmp_path: Path, text: bool) -> None:
    rows = columns(20_000 if not text else 20, 9)
    rows["scale_0"][7] = -np.inf
    flat = repack_fields(rows[[name for name in rows.dtype.names if name != "scale_2"]])
    ply = read_ply(save(tmp_path / "a.ply", flat, text=text))
    expected = read_ply(save(tmp_path / "b.ply", rows, text=text)).gaussians
    for name in ("means", "quats", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(ply.gaussians, name), getattr(expected, name))
    scales, two = ply.gaussians.scales, expected.scales[:, :2]
    np.testing.assert_allclose(scales, np.column_stack([two, np.maximum(1e-3 * two.min(1), np.exp(-30))]), rtol=1e-5)
    assert "2D" in file_notes(ply.info)[0]
    assert "scale_2" not in ply.info.columns


@pytest.mark.parametrize("linear", [True, False])
@pytest.mark.parametrize("two", [True, False])
def test_files_of_4dgt_are_read(tmp_path: Path, linear: bool, two: bool) -> None:
    """Colours in [0, 1] as r, g, b, with activated opacities and scales; other programs keep logarithms."""
    rng = np.random.default_rng(0)
    names = ("x", "y", "z", "r", "g", "b", "opacity", "scale_0", "scale_1", "scale_2")[: 9 if two else 10]
    rows = columns(200, names=(*names, "rot_0", "rot_1", "rot_2", "rot_3"))
    colors, opacities, scales = rng.uniform(size=(200, 3)), rng.uniform(size=200), rng.uniform(0.01, 0.1, (200, 3))
    for i, name in enumerate("rgb"):
        rows[name] = colors[:, i]
    rows["opacity"] = opacities
    for i, name in enumerate(names[7:]):
        rows[name] = scales[:, i] if linear else elementary.log(scales[:, i])
    ply = read_ply(save(tmp_path / "a.ply", rows))
    np.testing.assert_allclose(sh0_to_rgb(ply.gaussians.sh0)[:, 0], colors, atol=1e-6)
    np.testing.assert_allclose(ply.gaussians.opacities, opacities, rtol=1e-6)
    np.testing.assert_allclose(ply.gaussians.scales[:, : 3 - two], scales[:, : 3 - two], rtol=1e-5)
    assert ply.info.extra_columns == ()
    assert any("read as linear" in note for note in file_notes(ply.info)) == linear


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return drawn(scenes.make_scene(scenes.room(), scenes.arc(2, 48, 36)), 3)


@pytest.mark.parametrize("ending", [".spz", ".splat"])
def test_a_file_is_read_as_by_a_slow_reader(ending: str, gaussians: Gaussians, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending.upper()}"
    write_gaussians(path, gaussians)
    expected, actual = {".spz": read_spz, ".splat": read_splat}[ending](path), read_gaussians(path)
    assert actual.valid.all()
    for name, array in vars(expected).items():
        np.testing.assert_allclose(getattr(actual.gaussians, name), array, rtol=1e-5, atol=1e-5, err_msg=name)


def test_layouts_of_other_formats_are_described_in_the_info(gaussians: Gaussians, tmp_path: Path) -> None:
    names = {
        ".spz": ".spz version 3, SH degree 3",
        ".splat": ".splat, SH degree 0",
        ".sog": ".sog version 2, SH degree 3",
    }
    for ending, layout in names.items():
        write_gaussians(tmp_path / f"a{ending}", gaussians)
        info = read_gaussians(tmp_path / f"a{ending}").info
        assert (info.layout, info.count, info.opacity_encoding) == (layout, len(gaussians), "raw")
        assert info.file_bytes == (tmp_path / f"a{ending}").stat().st_size
        assert not info.opacity_guessed
        if ending != ".spz":  # whose sizes are those before gzip
            assert 0.5 * info.file_bytes < sum(info.bytes_by_attribute.values()) <= info.file_bytes


@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_the_render_mode_of_a_file_is_passed_on(ending: str, gaussians: Gaussians, tmp_path: Path) -> None:
    for name, comments in {"mip": ["SplatRenderMode: mip"], "plain": []}.items():
        write_gaussians(tmp_path / f"{name}{ending}", gaussians, comments=comments)
        assert list(kept_comments(read_gaussians(tmp_path / f"{name}{ending}").info)) == comments


def test_parts_have_one_encoding_of_opacities(tmp_path: Path) -> None:
    """A few rows say nothing of it; more that contradict others are refused, unless the caller says what all are."""
    paths = []
    for i, (count, low, high) in enumerate([(300, -3, 3), (20, 0.1, 0.9), (300, 0.12, 0.995)]):
        rows = columns(count)
        rows["opacity"] = np.linspace(low, high, count)
        paths.append(save(tmp_path / f"{i}.ply", rows))
    opacities = read_parts(paths[:2]).gaussians.opacities
    assert opacities[300] == pytest.approx(1 / (1 + np.exp(-0.1)))
    for order in (paths, paths[::-1]):
        with refuses(SceneError, "", order[0].name, "opacity=logit"):
            read_parts(order)
    assert read_parts(paths, opacity="logit").gaussians.opacities[-1] == pytest.approx(1 / (1 + np.exp(-0.995)))
    assert read_parts(paths[:0:-1]).gaussians.opacities[0] == pytest.approx(0.12)


def table_of(count: int) -> np.ndarray:
    """Return rows of Gaussians in the layout of INRIA, none of which is empty."""
    names = ("x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3)),
             *(f"rot_{i}" for i in range(4)))  # fmt: skip
    values = np.random.default_rng(0).uniform(0.1, 1, (count, len(names))).astype(np.float32)
    return values.view([(name, "f4") for name in names]).reshape(-1)


@pytest.mark.parametrize("turned", [True, False])
def test_empty_rows_are_set_aside(tmp_path: Path, turned: bool) -> None:
    """Rows of zeros, with or without a rotation; one Gaussian at the origin is none of them."""
    rows = table_of(50)
    rows[[3, 7, 48]] = 0
    rows["rot_0"][[3, 7, 48]] = turned
    for name in "xyz":
        rows[name][20] = 0
    actual = read_ply(save(tmp_path / "a.ply", rows))
    assert np.flatnonzero(~actual.valid).tolist() == [3, 7, 48]
    assert (actual.info.num_empty, actual.info.num_nonfinite, actual.info.num_zero_quats) == (3, 0, 0)
    assert not actual.gaussians.opacities[[3, 7, 48]].any()
    assert not noted(file_notes(actual.info), "interrupted")
    assert noted(file_notes(actual.info), "3 empty rows")


@pytest.mark.parametrize(("count", "is_doubt"), [(1, False), (2, True)])
@pytest.mark.parametrize(("name", "value"), [("x", 1e14), ("scale_1", 40), ("f_dc_2", 1e7)])
def test_files_with_more_than_stray_impossible_rows_are_doubted(
    tmp_path: Path, name: str, value: float, count: int, is_doubt: bool
) -> None:
    rows = table_of(100)
    rows[name][20 : 20 + count] = value
    actual = read_ply(save(tmp_path / "a.ply", rows))
    assert actual.info.num_nonfinite == count
    assert noted(list_doubts(file_notes(actual.info)), f"{count} of 100 rows", "binary mode") == is_doubt


@pytest.mark.parametrize(("last", "others", "broken"), [(30, 0, True), (30, 9, True), (3, 9, False), (1, 0, False)])
def test_files_that_broke_off_are_noted(tmp_path: Path, last: int, others: int, broken: bool) -> None:
    rows = table_of(100)
    rows[-last:] = 0
    rows[:others] = 0
    assert noted(file_notes(read_ply(save(tmp_path / "a.ply", rows)).info), "interrupted") == broken
