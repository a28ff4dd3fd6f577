"""All versions of ``.spz`` are read, and damaged files are refused."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from damage.gaussians import add_record, axes_record
from former_formats import spz4_bytes
from slow_readers import corners
from sweeps import sweep

from gsmerge import Gaussians, SceneError
from gsmerge.errors import list_doubts
from gsmerge.io import kept_comments, read_gaussians, write_gaussians
from gsmerge.io.formats.glb import glb_bytes
from gsmerge.io.formats.read_gaussians import file_notes
from gsmerge.io.formats.splat import splat_bytes
from gsmerge.io.formats.spz import AXIS_SYSTEMS, HARMONIC_STEP, gzip_bytes, spz_bytes
from gsmerge.io.formats.table import Contents
from gsmerge.method.geometry.transforms import covariances, rotate_harmonics
from gsmerge.results.outputs import name_outputs, write_outputs
from gsmerge.settings.files import FileOptions

# Two Gaussians of degree 1 as @adobe/spz 0.2.3 writes them, which is Niantic's library for browsers
NIANTIC = bytes.fromhex(
    "4e4753500400000002000000010c0006200000000000000000000000000000001b0000000000000012000000000000000b00"
    "00000000000002000000000000000f0000000000000006000000000000000f00000000000000060000000000000011000000"
    "0000000008000000000000001b00000000000000120000000000000028b52ffd201291000000180000e0ff00040000000000"
    "00000080ff28b52ffd2002110000ff3328b52ffd2006310000a6805980938028b52ffd2006310000a0908070605028b52ffd"
    "2008410000000000c069a5953628b52ffd2012910000a08080a08080a080808040c08040c08040c0"
)


def some_gaussians(degree: int, count: int = 50) -> Gaussians:
    rng = np.random.default_rng(degree)
    quats = rng.normal(size=(count, 4))
    columns = (
        rng.normal(size=(count, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.01, 0.1, (count, 3)),
        rng.uniform(size=count),
        rng.normal(size=(count, 1, 3)),
        rng.uniform(-0.5, 0.5, (count, (degree + 1) ** 2 - 1, 3)),
    )
    return Gaussians(*(column.astype(np.float32) for column in columns))


def test_a_spz_of_niantic_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(NIANTIC)
    ply = read_gaussians(tmp_path / "a.spz")
    actual = ply.gaussians
    assert ply.info.layout == ".spz version 4, SH degree 1"
    np.testing.assert_array_equal(actual.means, [[1.5, -2, 0.25], [0, 0, -8]])
    np.testing.assert_allclose(np.log(actual.scales), [[0, -1, -2], [-3, -4, -5]], atol=1e-5)
    np.testing.assert_allclose(actual.opacities, [1, 0.2])
    np.testing.assert_allclose(actual.sh0[:, 0], [[1, 0, -1], [0, 0.5, 0]], atol=0.02)
    np.testing.assert_allclose(
        np.abs(actual.quats @ [[1, 0.5], [0, 0.5], [0, -0.5], [0, 0.5]]).diagonal(), 1, atol=2e-3
    )
    np.testing.assert_allclose(actual.shN[:, 1], [[0.25, 0, 0], [0, -0.5, 0.5]])


@pytest.mark.parametrize("name", ["a.spz", "tileset.json"])
def test_rounding_of_harmonics_is_fine_and_moves_no_mean(name: str, tmp_path: Path) -> None:
    """Values between two steps go to the nearer one; halves that all went up would shift all colours."""
    gaussians = some_gaussians(3, count=2000)
    write_outputs(name_outputs(tmp_path / name, FileOptions(viewer_cameras=False)), Contents([gaussians]))
    errors = read_gaussians(tmp_path / name).gaussians.shN - gaussians.shN
    assert np.abs(errors).max() <= HARMONIC_STEP / 256 + 1e-6
    assert abs(errors.mean()) < 1e-4


@pytest.mark.parametrize("version", [1, 2])
def test_older_versions_of_spz_are_read(version: int, tmp_path: Path) -> None:
    position = struct.pack("<3e", 1.5, -2, 0.25) if version == 1 else b"".join(
        int(v * 4096).to_bytes(3, "little", signed=True) for v in (1.5, -2, 0.25)
    )  # fmt: skip
    half = round((0.5**0.5 + 1) * 127.5)
    rest = bytes([255, 128, 128, 128, 160, 144, 128, half, 128, 128])
    data = struct.pack("<3I4B", 0x5053474E, version, 1, 0, 12, 0, 0) + position + rest
    (tmp_path / "a.spz").write_bytes(gzip.compress(data))
    actual = read_gaussians(tmp_path / "a.spz").gaussians
    np.testing.assert_allclose(actual.means[0], (1.5, -2, 0.25))
    np.testing.assert_allclose(actual.quats[0], (0.5**0.5, 0.5**0.5, 0, 0), atol=0.01)
    np.testing.assert_allclose(actual.scales[0], np.exp((0.0, -1, -2)), rtol=1e-6)
    assert actual.opacities[0] == 1


def test_version_2_has_rotations_of_a_byte_each(tmp_path: Path) -> None:
    """All else is as in version 3."""
    for version in (2, 3):
        contents = Contents([some_gaussians(3)], options=FileOptions(spz_version=version))
        (tmp_path / f"{version}.spz").write_bytes(spz_bytes(some_gaussians(3), contents))
    old, new = (read_gaussians(tmp_path / f"{version}.spz") for version in (2, 3))
    assert old.info.layout == ".spz version 2, SH degree 3"
    assert float(np.abs((old.gaussians.quats * some_gaussians(3).quats).sum(1)).min()) > 0.99
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(old.gaussians, name), getattr(new.gaussians, name))


def test_harmonics_of_degree_4_are_read_in_version_4(tmp_path: Path) -> None:
    path, gaussians = tmp_path / "a.spz", some_gaussians(4)
    path.write_bytes(spz4_bytes(gaussians, mip=True))
    ply = read_gaussians(path)
    assert ply.info.bytes_by_attribute["shN"] == 72 * len(gaussians)
    assert float(np.abs(ply.gaussians.shN - gaussians.shN).max()) <= 8.5 / 128
    np.testing.assert_allclose(ply.gaussians.means, gaussians.means, atol=1e-4)
    assert list(kept_comments(ply.info)) == ["SplatRenderMode: mip"]
    write_gaussians(tmp_path / "b.spz", gaussians)
    assert read_gaussians(tmp_path / "b.spz").info.layout == ".spz version 3, SH degree 3"


@pytest.mark.parametrize("more", [b"", struct.pack("<2I3f", 0xADBE0002, 12, 0, 1, 2), axes_record(0), axes_record(6)])
@pytest.mark.parametrize("write", [spz_bytes, spz4_bytes])
def test_extensions_without_an_effect_change_nothing(
    tmp_path: Path, write: Callable[[Gaussians], bytes], more: bytes
) -> None:
    """Limits of an orbit, and axes that say nothing or are those of a ``.ply``."""
    for name, data in {"plain": write(some_gaussians(1)), "more": add_record(write(some_gaussians(1)), more)}.items():
        (tmp_path / f"{name}.spz").write_bytes(data)
    plain, extended = (read_gaussians(tmp_path / f"{name}.spz") for name in ("plain", "more"))
    assert file_notes(extended.info) == ()
    for name, array in vars(plain.gaussians).items():
        np.testing.assert_array_equal(getattr(extended.gaussians, name), array)


@pytest.mark.parametrize(("number", "axes"), list(enumerate(AXIS_SYSTEMS, 1)))
@pytest.mark.parametrize("write", [spz_bytes, spz4_bytes])
def test_axes_are_turned_to_those_of_a_ply(
    tmp_path: Path, write: Callable[[Gaussians], bytes], number: int, axes: str
) -> None:
    """Of both hands: world directions of positions, ellipsoids and colours stay the same."""
    content, orbit = write(some_gaussians(2)), struct.pack("<2I3f", 0xADBE0002, 12, 0, 1, 2)
    (tmp_path / "plain.spz").write_bytes(content)
    (tmp_path / "axes.spz").write_bytes(add_record(content, orbit + axes_record(number)))
    plain, ply = read_gaussians(tmp_path / "plain.spz").gaussians, read_gaussians(tmp_path / "axes.spz")
    world = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
    turn, turned = np.array([world[letter] for letter in axes], float).T, ply.gaussians
    turn *= (1, -1, -1) if axes in ("LFD", "RFD", "LBU", "RBU") else 1  # as Niantic's library 0.2.3 does
    np.testing.assert_allclose(turned.means, plain.means @ turn.T, atol=1e-6)
    expected = turn @ covariances(plain.quats, plain.scales) @ turn.T
    np.testing.assert_allclose(covariances(turned.quats, turned.scales), expected, atol=1e-7)
    signs = np.array([[-1.0], [1], [-1]])  # degree 1 is a vector: -y, z and -x
    before, after = ((g.shN[:, :3] * signs)[:, [2, 0, 1]] for g in (plain, turned))
    np.testing.assert_allclose(after, turn @ before, atol=1e-5)
    np.testing.assert_allclose(turned.shN, rotate_harmonics(plain.shN, turn), atol=1e-5)
    assert bool(file_notes(ply.info)) == (axes != "RDF")
    assert all(axes in note for note in file_notes(ply.info))


@pytest.mark.parametrize(("how", "word"), [((9, zlib.Z_DEFAULT_STRATEGY), b"\2"), ((1, zlib.Z_RLE), b"\4")])
def test_gzip_streams_are_the_same_at_any_time_on_any_system(how: tuple[int, ...], word: bytes) -> None:
    """Python 3.10 to 3.13 write one of two systems into what ``gzip.compress`` returns."""
    data = spz_bytes(corners())
    actual = gzip_bytes([data], level=how[0], strategy=how[1])
    assert actual[:10] == b"\x1f\x8b\x08" + bytes(5) + word + b"\3"
    assert gzip.decompress(actual) == data
    assert data[:10] == gzip_bytes([b""])[:10]


def test_a_spz_of_a_wrong_version_raises_no_warning(tmp_path: Path) -> None:
    data = gzip.decompress(spz_bytes(some_gaussians(0, 2000)))
    (tmp_path / "a.spz").write_bytes(gzip.compress(data[:4] + struct.pack("<I", 1) + data[8:]))
    assert 0 < read_gaussians(tmp_path / "a.spz").info.num_nonfinite < 2000  # warnings are errors in tests


def checked_spz4(gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """Return a ``.spz`` of version 4 whose streams have checksums."""
    compressor = zstandard.ZstdCompressor
    monkeypatch.setattr(zstandard, "ZstdCompressor", lambda level: compressor(level=level, write_checksum=True))
    return spz4_bytes(gaussians)


@sweep("version", [3, 4])
def test_damage_that_a_checksum_shows_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int) -> None:
    """One wrong bit anywhere in the compressed columns, or a stream without its end."""
    content = spz_bytes(some_gaussians(0)) if version == 3 else checked_spz4(some_gaussians(0), monkeypatch)
    start = 10 if version == 3 else 32 + 5 * 16  # of what is compressed
    flipped = [content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :] for at in range(start, len(content))]
    for damaged in (*flipped, content[:-1], content[:-4], content[:-8]):
        (tmp_path / "a.spz").write_bytes(damaged)
        with pytest.raises(SceneError):
            read_gaussians(tmp_path / "a.spz")


@pytest.mark.parametrize("write", [spz_bytes, spz4_bytes])
@pytest.mark.parametrize(("num_more", "is_doubtful"), [(15, False), (16, True)])
def test_more_than_padding_after_the_streams_is_a_doubt(
    tmp_path: Path, write: Callable[[Gaussians], bytes], num_more: int, is_doubtful: bool
) -> None:
    (tmp_path / "a.spz").write_bytes(write(some_gaussians(0)) + bytes(num_more))
    notes = file_notes(read_gaussians(tmp_path / "a.spz").info)
    assert [note.startswith("16 bytes follow") for note in list_doubts(notes)] == [True] * is_doubtful


def test_the_size_of_blocks_does_not_change_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = {writer: writer(corners()) for writer in (spz_bytes, splat_bytes, glb_bytes)}
    monkeypatch.setattr("gsmerge.io.formats.rows.BLOCK_ROWS", 3)
    assert {writer: writer(corners()) for writer in whole} == whole
