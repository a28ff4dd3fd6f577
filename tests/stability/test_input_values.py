"""Hostile values and layouts in a ``.ply``: read correctly, or refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.io import load_scene, read_ply, read_scene, write_ply
from gsmerge.types import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def change(path: Path, edit: Callable[[np.ndarray], np.ndarray | None], **form: object) -> None:
    """Rewrite the rows of a ``.ply``."""
    data = PlyData.read(str(path), mmap=False)
    rows = data["vertex"].data.copy()
    edited = edit(rows)
    element = PlyElement.describe(rows if edited is None else edited, "vertex")
    PlyData([element], **{"byte_order": "<", **form}).write(str(path))


def assert_sound(gaussians: Gaussians) -> None:
    """The invariants of everything in memory."""
    assert all(np.isfinite(getattr(gaussians, name)).all() for name in FIELDS)
    assert (gaussians.scales > 0).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()
    np.testing.assert_allclose(np.linalg.norm(gaussians.quats, axis=1), 1, atol=1e-5)


def test_overflowing_and_underflowing_scales(scene_copy: Path) -> None:
    def edit(rows: np.ndarray) -> None:
        rows["scale_0"][:50] = 40
        rows["scale_1"][25:75] = -40

    change(scene_copy / "scene.ply", edit)
    loaded = load_scene(scene_copy)
    assert_sound(loaded.scene.gaussians)
    assert loaded.ply.num_clipped_scales == 75
    assert loaded.scene.valid.all()


def test_saturated_opacities_survive_a_round_trip(scene_copy: Path, tmp_path: Path) -> None:
    def edit(rows: np.ndarray) -> None:
        rows["opacity"][::3] = np.inf
        rows["opacity"][1::3] = -np.inf

    change(scene_copy / "scene.ply", edit)
    scene = read_scene(scene_copy)
    assert scene.valid.all()
    assert (scene.gaussians.opacities[::3] == 1).all()
    assert (scene.gaussians.opacities[1::3] == 0).all()
    write_ply(tmp_path / "again.ply", scene.gaussians)
    again = read_ply(tmp_path / "again.ply").gaussians
    np.testing.assert_allclose(again.opacities, scene.gaussians.opacities, rtol=0, atol=1e-6)


def test_activated_opacities_are_not_activated_again(scene_copy: Path) -> None:
    logits = read_scene(scene_copy).gaussians.opacities
    change(scene_copy / "scene.ply", lambda rows: rows["opacity"].__setitem__(slice(None), logits))
    loaded = load_scene(scene_copy)
    assert loaded.ply.opacity_encoding == "raw"
    np.testing.assert_array_equal(loaded.scene.gaussians.opacities, logits)


def test_zero_scaled_and_negated_quaternions(scene_copy: Path) -> None:
    before = read_scene(scene_copy).gaussians.quats

    def edit(rows: np.ndarray) -> None:
        for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
            rows[name][:100] = 0
            rows[name][100:200] *= -7
            rows[name][200:300] *= 1e-25

    change(scene_copy / "scene.ply", edit)
    loaded = load_scene(scene_copy)
    assert_sound(loaded.scene.gaussians)
    assert loaded.ply.num_zero_quats == 100
    quats = loaded.scene.gaussians.quats
    assert (quats[:100] == [1, 0, 0, 0]).all()
    np.testing.assert_allclose(quats[100:200], -before[100:200], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(quats[200:], before[200:], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_rows_that_are_not_finite_keep_their_pixels(scene_copy: Path, value: float) -> None:
    before = read_scene(scene_copy)
    rng = np.random.default_rng(0)
    bad = np.sort(rng.choice(len(before.gaussians), 500, replace=False))

    def edit(rows: np.ndarray) -> None:
        for i, row in enumerate(bad):
            rows[("x", "y", "z", "f_dc_0", "rot_2")[i % 5]][row] = value

    change(scene_copy / "scene.ply", edit)
    loaded = load_scene(scene_copy)
    assert loaded.ply.num_nonfinite == 500
    assert np.flatnonzero(~loaded.scene.valid).tolist() == bad.tolist()
    assert_sound(loaded.scene.gaussians)
    assert not loaded.scene.gaussians.opacities[bad].any()
    good = loaded.scene.valid.reshape(-1)
    for name in FIELDS:
        a, b = getattr(loaded.scene.gaussians, name), getattr(before.gaussians, name)
        np.testing.assert_array_equal(a[good], b[good], name)


def test_a_file_without_a_finite_row(scene_copy: Path) -> None:
    change(scene_copy / "scene.ply", lambda rows: rows["y"].fill(np.nan))
    with pytest.raises(SceneError, match="expected finite Gaussians, found NaN or inf in all"):
        read_scene(scene_copy)


@pytest.mark.parametrize("form", [{"text": True}, {"byte_order": ">"}, {"double": True}, {"reverse": True}])
def test_variants_of_the_format_read_alike(scene_copy: Path, form: dict) -> None:
    before = read_scene(scene_copy)
    form = dict(form)
    names = PlyData.read(str(scene_copy / "scene.ply"))["vertex"].data.dtype.names
    order = names[::-1] if form.pop("reverse", False) else names
    kind = "f8" if form.pop("double", False) else "f4"

    def edit(rows: np.ndarray) -> np.ndarray:
        out = np.zeros(len(rows), [(name, form.get("byte_order", "<") + kind) for name in order])
        for name in names:
            out[name] = rows[name]
        return out

    change(scene_copy / "scene.ply", edit, **form)
    after = read_scene(scene_copy)
    for name in FIELDS:
        a, b = getattr(after.gaussians, name).astype(np.float32), getattr(before.gaussians, name)
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7, err_msg=name)


def test_channel_major_harmonics_of_every_degree(scene_copy: Path, tmp_path: Path) -> None:
    few = read_scene(scene_copy).gaussians[:64]
    for degree in range(5):
        higher = (degree + 1) ** 2 - 1
        shN = np.arange(64 * higher * 3, dtype=np.float32).reshape(64, higher, 3)
        path = tmp_path / f"{degree}.ply"
        write_ply(path, Gaussians(few.means, few.quats, few.scales, few.opacities, few.sh0, shN))
        actual = read_ply(path)
        assert actual.info.sh_degree == degree
        np.testing.assert_array_equal(actual.gaussians.shN, shN)


def test_coordinates_far_from_the_origin(scene_copy: Path) -> None:
    """As a survey's eastings and northings, which need float64."""
    shift = {"x": 4e5, "y": 5e6, "z": 100.0}
    before = read_scene(scene_copy).gaussians.means

    def edit(rows: np.ndarray) -> np.ndarray:
        out = rows.astype([(name, "<f8") for name in rows.dtype.names])
        for name, amount in shift.items():
            out[name] += amount
        return out

    change(scene_copy / "scene.ply", edit)
    after = read_ply(scene_copy / "scene.ply").gaussians.means
    assert after.dtype == np.float64
    np.testing.assert_allclose(after - list(shift.values()), before, rtol=0, atol=1e-6)


def test_the_way_to_render_is_passed_on(scene_copy: Path, tmp_path: Path) -> None:
    """Case 43: files whose Gaussians carry a filter of their own say so in the header."""
    ply = scene_copy / "scene.ply"
    head, rows = ply.read_bytes().split(b"end_header\n", 1)
    head = head.replace(
        b"element vertex",
        b"comment SplatRenderMode: mip\ncomment SplatRenderMode:\tx\ncomment of no use\nelement vertex",
    )
    ply.write_bytes(head + b"end_header\n" + rows)
    out = tmp_path / "small.ply"
    assert main(["compact", str(scene_copy), "-o", str(out), "--fit", "none", "--superpixels", "20", "-q"]) == 0
    comments = read_ply(out).info.comments
    assert "SplatRenderMode: mip" in comments
    assert "of no use" not in comments
    with pytest.raises(ValueError, match="lines of ASCII"):
        write_ply(tmp_path / "bad.ply", read_ply(out).gaussians, comments=["one\nelement vertex 5"])
