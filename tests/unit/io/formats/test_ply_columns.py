"""Columns that change what is drawn are worked in, refused, or named in one note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from messages import names, refuses
from plyfile import PlyElement

from gsmerge.errors import SceneError
from gsmerge.io import read_ply
from gsmerge.io.formats.read_gaussians import file_notes

from .test_read_gaussians import NAMES, columns, save

MOTION = tuple(f"motion_{i}" for i in range(9))


def with_columns(path: Path, *more: str, kind: str = "<f4") -> Path:
    old = columns(6)
    rows = np.zeros(6, [*((name, "<f4") for name in NAMES), *((name, kind) for name in more)])
    for name in NAMES:
        rows[name] = old[name]
    return save(path, rows)


@pytest.mark.parametrize(
    "more",
    [
        ("trbf_center", "trbf_scale", *MOTION), ("t", "scaling_t"), ("t", "scale_t_0", "rot_r_0"), ("t_scale",),
        ("velocity_0", "lifespan"), ("velocity_x", "duration"), ("f_offset_0", "f_anchor_feat_0"),
    ],
)  # fmt: skip
def test_columns_of_gaussians_that_change_in_time_are_refused(more: tuple[str, ...], tmp_path: Path) -> None:
    known = next(name for name in more if name.startswith(("trbf", "scal", "t_", "life", "dur", "f_off")))
    with refuses(SceneError, "a.ply", known):
        read_ply(with_columns(tmp_path / "a.ply", *more))


def test_columns_to_refuse_are_named_before_missing_ones(tmp_path: Path) -> None:
    left = tuple(f"rot_l_{i}" for i in range(4))
    rows = columns(names=(*(name for name in NAMES if name[:3] != "rot"), *left, "t_scale"))
    with refuses(SceneError, "a.ply", "t_scale", "moment"):
        read_ply(save(tmp_path / "a.ply", rows))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (MOTION, (*MOTION[:6], "3 more", "motion")),
        (("t",), ("t", "time")),
        (("albedo_0", "roughness", "Metallic"), ("albedo_0", "roughness", "Metallic", "materials")),
        (("nu",), ("nu", "primitives")),
        (("nu_degree", "omega_0"), ("nu_degree", "primitives", "omega_0", "motion")),
        (("opacity_2", "foo"), ("opacity_2", "foo", "unknown")),
    ],
)
def test_unused_columns_are_in_one_note(more: tuple[str, ...], said: tuple[str, ...], tmp_path: Path) -> None:
    ply = read_ply(with_columns(tmp_path / "a.ply", *more, "label", "semantic_0", "red", "confidence"))
    (note,) = file_notes(ply.info)
    assert names(note, *said)
    assert not names(note, "label")
    assert not names(note, "semantic_0")
    assert ply.info.extra_columns == (*more, "label", "semantic_0", "red", "confidence")


def test_unknown_columns_of_whole_numbers_have_no_note(tmp_path: Path) -> None:
    assert file_notes(read_ply(with_columns(tmp_path / "a.ply", "foo", kind="u1")).info) == ()


def test_more_gaussians_in_another_element_are_named(tmp_path: Path) -> None:
    path = save(tmp_path / "a.ply", columns(), before=(PlyElement.describe(columns(), "sky"),))
    assert names(file_notes(read_ply(path).info)[0], "element sky")


@pytest.mark.parametrize(
    ("name", "kind", "found"),
    [("x", "<u2", "ushort"), ("scale_1", "i2", "short"), ("rot_0", "u1", "uchar"), ("opacity", "<u2", "ushort"),
     ("f_dc_2", "<u2", "ushort"), ("f_rest_3", "u1", "uchar"), ("z", "<i4", "int")],
)  # fmt: skip
def test_whole_numbers_in_the_place_of_floats_are_refused(name: str, kind: str, found: str, tmp_path: Path) -> None:
    rows = columns(4, num_rest=9)
    rows = rows.astype([(each, kind if each == name else "<f4") for each in rows.dtype.names])
    with refuses(SceneError, "a.ply", name, found, "float"):
        read_ply(save(tmp_path / "a.ply", rows))


@pytest.mark.parametrize(("kind", "right"), [("u1", True), ("<f8", True), ("<u2", False)])
def test_plain_colours_are_bytes_or_floats(kind: str, right: bool, tmp_path: Path) -> None:
    rows = columns(names=(*NAMES[:6], "red", "green", "blue", *NAMES[9:]))
    rows = rows.astype([(name, kind if name in ("red", "green", "blue") else "<f4") for name in rows.dtype.names])
    path = save(tmp_path / "a.ply", rows)
    if right:
        assert file_notes(read_ply(path).info) == ()
        return
    with refuses(SceneError, "a.ply", "red", "ushort"):
        read_ply(path)


def test_kernels_of_beta_splats_are_refused(tmp_path: Path) -> None:
    with refuses(SceneError, "a.ply", "beta", "sb_params_0", "Beta splats"):
        read_ply(with_columns(tmp_path / "a.ply", "beta", "sb_params_0"))


def test_opacities_of_0_to_255_are_refused(tmp_path: Path) -> None:
    """Unless the caller says that they are logits; logits of opaque Gaussians stay logits."""
    rows = columns(300)
    rows["opacity"] = np.arange(300) % 256
    path = save(tmp_path / "a.ply", rows)
    with refuses(SceneError, "a.ply", "0 to 255", "opacity=logit"):
        read_ply(path)
    assert read_ply(path, opacity="logit").info.opacity_encoding == "logit"
    rows["opacity"] = np.linspace(0, 12, 300)
    assert read_ply(save(tmp_path / "b.ply", rows)).info.opacity_encoding == "logit"
    with refuses(SceneError, "c.ply", "opacity", "uchar", "0 to 255"):
        read_ply(save(tmp_path / "c.ply", rows.astype([(n, "u1" if n == "opacity" else "<f4") for n in NAMES])))


def test_columns_of_rotations_may_have_another_name(tmp_path: Path) -> None:
    rows = columns(6)
    path = save(tmp_path / "a.ply", rows)
    rows.dtype.names = tuple(name.replace("rot_", "rotation_") for name in NAMES)
    other = read_ply(save(tmp_path / "b.ply", rows))
    assert np.array_equal(other.gaussians.quats, read_ply(path).gaussians.quats)
    assert other.info.extra_columns == ()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [(b"0.5", b"0,5", ("commas", "decimal points")), (b"float x", b"half x", ("'half'", "float"))],
)
def test_decimal_commas_or_unknown_types_are_refused(
    tmp_path: Path, old: bytes, new: bytes, said: tuple[str, ...]
) -> None:
    head = "".join(f"property float {name}\n" for name in NAMES)
    text = f"ply\nformat ascii 1.0\nelement vertex 1\n{head}end_header\n{'0.5 ' * len(NAMES)}\n".encode()
    (path := tmp_path / "a.ply").write_bytes(text)
    assert len(read_ply(path).gaussians) == 1
    path.write_bytes(text.replace(old, new))
    with refuses(SceneError, "a.ply", *said):
        read_ply(path)


def quats_at(shift: int, axis: int | None, *, unit: bool = True) -> np.ndarray:
    """Return rows of unit quaternions, whose values are moved to the right, in their row or along all rows."""
    rng = np.random.default_rng(0)
    values = rng.uniform(-2, 2, (9, len(NAMES)))
    quats = values[:, NAMES.index("rot_0") :][:, :4]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True) if unit else 1.0
    moved = np.roll(values, shift, axis).astype("<f4")
    return moved.view([(name, "<f4") for name in NAMES])[:, 0]


@pytest.mark.parametrize("axis", [1, None], ids=["in each row", "along all rows"])
@pytest.mark.parametrize(("shift", "words"), [(1, "1 place after"), (-1, "1 place before"), (3, "3 places after")])
def test_values_beside_their_columns_are_refused(shift: int, words: str, axis: int | None, tmp_path: Path) -> None:
    with refuses(SceneError, "a.ply", "rot_0", words):
        read_ply(save(tmp_path / "a.ply", quats_at(shift, axis)))


def test_quaternions_of_any_norm_are_read(tmp_path: Path) -> None:
    assert len(read_ply(save(tmp_path / "a.ply", quats_at(0, 1))).gaussians) == 9
    assert len(read_ply(save(tmp_path / "b.ply", quats_at(0, 1, unit=False))).gaussians) == 9
    assert len(read_ply(save(tmp_path / "c.ply", quats_at(1, 1, unit=False))).gaussians) == 9
