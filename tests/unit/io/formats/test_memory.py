"""Reading takes at most 64 MB and 20 times a file's bytes, as processes of their own measure."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from former_formats import compressed_bytes
from messages import refuses
from sweeps import sweep

from gsmerge.errors import SceneError
from gsmerge.io import write_gaussians, write_ply
from gsmerge.io.bounds import ReadBudget
from gsmerge.io.formats.rows import check_gaussian_count
from gsmerge.io.formats.sog import PACKED_BYTES
from gsmerge.method.geometry.transforms import normalize
from gsmerge.method.kernels import elementary
from gsmerge.types import Gaussians

COUNT, HIGHER = 150_000, 15
FREE, PER_BYTE = 64_000_000, 20
FILES = {  # Gaussians that 64 MB are not enough for, as smaller ones say nothing
    ".ply": COUNT, ".compressed.ply": COUNT, ".spz": COUNT, ".sog": COUNT, ".glb": COUNT, ".splat": 3 * COUNT,
}  # fmt: skip
READ = """
import re, sys
from pathlib import Path
from gsmerge.io import read_gaussians
small, path = sys.argv[1:]
read_gaussians(small)  # whatever is loaded once
peak = lambda: 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
before = peak()
read_gaussians(path)
print(peak() - before)
"""

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux counts it")


def some(count: int) -> Gaussians:
    """Make Gaussians along a walk, few of which have harmonics of their own: they pack well."""
    rng = np.random.default_rng(0)
    means = np.cumsum(rng.normal(0, 0.02, (count, 3)), 0).astype(np.float32)
    quats = normalize(rng.normal(size=(50, 4)).astype(np.float32))[rng.integers(0, 50, count)]
    scales = elementary.exp(rng.normal(-4, 1, (50, 3)).astype(np.float32))[rng.integers(0, 50, count)]
    shN = rng.normal(0, 0.1, (50, HIGHER, 3)).astype(np.float32)[np.arange(count) // 100 % 50]
    return Gaussians(means, quats, scales, np.full(count, 0.5, np.float32), shN[:, :1], shN)


@pytest.mark.slow
@sweep("ending", FILES)
def test_reading_a_file_takes_no_more_memory_than_its_budget(ending: str, tmp_path: Path) -> None:
    small, path = tmp_path / f"small{ending}", tmp_path / f"large{ending}"
    for place, count in {small: 300, path: FILES[ending]}.items():
        if ending == ".compressed.ply":
            place.write_bytes(compressed_bytes(some(count)))
        else:
            write_gaussians(place, some(count))
    peak = subprocess.run([sys.executable, "-c", READ, small, path], check=True, capture_output=True, text=True).stdout
    assert int(peak) <= FREE + PER_BYTE * path.stat().st_size


@pytest.mark.parametrize(("each", "num_higher"), [(8, 0), (10, 15), (12, 24)])
@pytest.mark.parametrize("count", [100_000, 1_000_000, 4_000_000, 20_000_000])
def test_files_as_dense_as_real_ones_are_within_the_budget(count: int, each: int, num_higher: int) -> None:
    """Bytes per Gaussian of the smallest .sog and .spz of real scenes, at any size; a twentieth of them are none."""
    check_gaussian_count(ReadBudget("a.sog", each * count), count, num_higher, PACKED_BYTES)
    with refuses(SceneError, "a.sog", f"{20 * count:,}"):
        check_gaussian_count(ReadBudget("a.sog", each * count), 20 * count, num_higher, PACKED_BYTES)


@pytest.mark.slow
def test_reading_text_takes_no_more_memory_than_its_budget(tmp_path: Path) -> None:
    """Numbers of one character, of columns of eight bytes."""
    small, path = tmp_path / "small.ply", tmp_path / "large.ply"
    write_ply(small, some(300))
    header = small.read_bytes().partition(b"end_header")[0].decode().replace("binary_little_endian", "ascii")
    rows = "1 " * header.count("property") + "\n"
    header = header.replace("float", "double").replace("vertex 300", "vertex 8000")
    path.write_text(f"{header}end_header\n" + rows * 8000)
    peak = subprocess.run([sys.executable, "-c", READ, small, path], check=True, capture_output=True, text=True).stdout
    assert int(peak) <= FREE + PER_BYTE * path.stat().st_size
