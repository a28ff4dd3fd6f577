"""Compressed files of a slow writer are read within the width of a bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from gsmerge.io import read_ply
from gsmerge.method.geometry.transforms import quat_to_rotmat
from gsmerge.types import SH_C0

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def pack_vector(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> int:
    x, y, z = (values - low) / np.maximum(high - low, 1e-12)
    return (round(x * 2047) << 21) | (round(y * 1023) << 11) | round(z * 2047)


def pack_rotation(quat: np.ndarray) -> int:
    largest = int(np.argmax(np.abs(quat)))
    quat = quat * np.sign(quat[largest])
    word = largest
    for i in range(4):
        if i != largest:
            word = (word << 10) | round((quat[i] / np.sqrt(2) + 0.5) * 1023)
    return word


def pack_color(values: np.ndarray) -> int:
    word = 0
    for value in values:
        word = (word << 8) | round(value * 255)
    return word


def write_compressed(path: Path, g: dict[str, np.ndarray], rest: int = 0, ranged: bool = False) -> None:
    n = len(g["means"])
    names = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"] if ranged else []
    chunks = np.zeros(-(-n // 256), [(name, "f4") for name in names])
    rows = np.zeros(n, [(name, "u4") for name in PACKED])
    for c in range(len(chunks)):
        mine = slice(256 * c, min(256 * c + 256, n))
        p, s, rgb = g["means"][mine], g["log_scales"][mine], g["colors"][mine]
        ends = [p.min(0), p.max(0), s.min(0), s.max(0)] + ([rgb.min(0), rgb.max(0)] if ranged else [])
        chunks[c] = tuple(np.concatenate(ends))
        for i in range(mine.start, mine.stop):
            shade = (g["colors"][i] - rgb.min(0)) / (rgb.max(0) - rgb.min(0)) if ranged else g["colors"][i]
            rows[i] = (
                pack_vector(g["means"][i], p.min(0), p.max(0)),
                pack_rotation(g["quats"][i]),
                pack_vector(g["log_scales"][i], s.min(0), s.max(0)),
                pack_color(np.append(shade, g["opacities"][i])),
            )
    elements = [PlyElement.describe(chunks, "chunk"), PlyElement.describe(rows, "vertex")]
    if rest:
        sh = np.zeros(n, [(f"f_rest_{i}", "u1") for i in range(rest)])
        for i in range(rest):
            sh[f"f_rest_{i}"] = np.clip(np.floor((g["sh"][:, i] / 8 + 0.5) * 256), 0, 255)
        elements.append(PlyElement.describe(sh, "sh"))
    PlyData(elements, byte_order="<").write(str(path))


@pytest.fixture
def made() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(300, 4))
    return {
        "means": rng.normal(size=(300, 3)),
        "log_scales": rng.uniform(-6, -2, (300, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "colors": rng.uniform(0.1, 0.9, (300, 3)),
        "opacities": rng.uniform(0, 1, 300),
        "sh": rng.uniform(-3.9, 3.9, (300, 45)),
    }


@pytest.mark.parametrize("rest", [0, 9, 24, 45])
@pytest.mark.parametrize("ranged", [False, True])
def test_packed_values_are_read_within_the_width_of_a_bit(
    tmp_path: Path, made: dict[str, np.ndarray], rest: int, ranged: bool
) -> None:
    write_compressed(tmp_path / "a.ply", made, rest, ranged)
    ply = read_ply(tmp_path / "a.ply")
    assert sum(ply.info.bytes_by_attribute.values()) == (16 + rest) * len(ply.gaussians) < ply.info.file_bytes
    g = ply.gaussians
    assert ply.info.layout.startswith("compressed")
    assert (ply.info.opacity_encoding, ply.info.opacity_guessed) == ("logit", False)
    assert np.abs(g.means - made["means"]).max() < 0.005  # half a step of 10 bits over about 6 units is 0.003
    assert np.abs(np.log(g.scales) - made["log_scales"]).max() < 0.003  # half a step of 10 bits over 4 is 0.002
    assert np.abs(g.opacities - made["opacities"]).max() < 0.003  # half a step of 8 bits is 0.002
    assert np.abs(0.5 + SH_C0 * g.sh0[:, 0] - made["colors"]).max() < 0.003
    turned = quat_to_rotmat(made["quats"].astype(np.float32))
    assert (
        np.abs(quat_to_rotmat(g.quats) - turned).max() < 0.006
    )  # a step of 10 bits over the square root of 2 is 0.0014
    assert g.shN.shape == (300, rest // 3, 3)
    for i in range(rest):
        channel, j = divmod(i, rest // 3)
        assert np.abs(g.shN[:, j, channel] - made["sh"][:, i]).max() < 8 / 256


def test_packed_opacities_of_zero_or_one_are_exact(tmp_path: Path, made: dict[str, np.ndarray]) -> None:
    made["opacities"][:2] = (0, 1)
    write_compressed(tmp_path / "a.ply", made)
    ply = read_ply(tmp_path / "a.ply")
    assert ply.valid.all()
    assert ply.gaussians.opacities[:2].tolist() == [0, 1]
