"""Slow, obvious readers check formats, and Gaussians to write are random or have extreme values."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.io import read_gaussians
from gsmerge.method.geometry.transforms import normalize
from gsmerge.method.kernels import elementary
from gsmerge.types import SH_C0


def drawn(scene: Scene, degree: int) -> Gaussians:
    """Return merged Gaussians with random rotations, sizes and harmonics."""
    rng = np.random.default_rng(degree)
    g = scenes.plain(scene, superpixels="10%")
    quats = normalize(rng.normal(size=g.quats.shape).astype(np.float32))
    shN = rng.normal(0, 0.1, (len(g), (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    scales = g.scales * rng.uniform(0.5, 1.5, g.scales.shape).astype(np.float32)
    return replace(g, means=g.means.astype(np.float32), quats=quats, scales=scales, shN=shN)


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
    scales = [[elementary.exp(v / 16 - 10) for v in r] for r in take(3)]
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


def corners() -> Gaussians:
    """Return Gaussians of extreme values: opacities 0 and 1, scales 0, colours beyond the range, a zero quaternion."""
    return Gaussians(
        means=np.array([[0.0, 0, 0], [1e5, -3, 2], [-7, 1e-8, 0.5]], np.float32),
        quats=np.array([[0.0, 0, 0, 0], [-0.6, 0, 0.8, 0], [0, 0, 0, -1.0]], np.float32),
        scales=np.array([[0.0, 1e-9, 1], [1e3, 1, 1], [0.01, 0.02, 0.03]], np.float32),
        opacities=np.array([0.0, 1.0, 0.5], np.float32),
        sh0=np.array([[[-9.0, 0, 9]], [[1, 2, 3]], [[0, 0, 0]]], np.float32),
        shN=np.zeros((3, 0, 3), np.float32),
    )
