"""Reading what other programs store beside .ply: .spz, .splat and .sog, whole and damaged."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scenes
from test_io_writing import corners, drawn, read_splat, read_spz

from gsmerge import Gaussians
from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.io import kept_comments, read_gaussians, write_gaussians
from gsmerge.io.formats.sog import fit_codebook, fit_palette, nearest_codes, sog_bytes
from gsmerge.io.formats.spz import spz_bytes


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return drawn(scenes.make_scene(scenes.room(), scenes.arc(3, 96, 72)), 3)


@pytest.mark.parametrize("ending", [".spz", ".splat"])
def test_the_same_as_a_slow_reader(ending: str, gaussians: Gaussians, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending.upper()}"
    write_gaussians(path, gaussians)
    expected, actual = {".spz": read_spz, ".splat": read_splat}[ending](path), read_gaussians(path)
    assert actual.valid.all()
    for name, array in vars(expected).items():
        np.testing.assert_allclose(getattr(actual.gaussians, name), array, rtol=1e-5, atol=1e-5, err_msg=name)


def test_what_the_file_is_called(gaussians: Gaussians, tmp_path: Path) -> None:
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


@pytest.mark.parametrize("version", [1, 2])
def test_older_spz(version: int, tmp_path: Path) -> None:
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


@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_a_filter_of_their_own_is_passed_on(ending: str, gaussians: Gaussians, tmp_path: Path) -> None:
    for name, comments in {"mip": ["SplatRenderMode: mip"], "plain": []}.items():
        write_gaussians(tmp_path / f"{name}{ending}", gaussians, comments=comments)
        assert list(kept_comments(read_gaussians(tmp_path / f"{name}{ending}").info)) == comments


def test_sog_keeps_what_is_transparent_or_opaque(tmp_path: Path) -> None:
    """Where every alpha is 255, or 0, WebP stores no alpha, or no colours."""
    for opacity in (0.0, 1.0):
        one = replace(corners(), opacities=np.full(3, opacity, np.float32))
        write_gaussians(tmp_path / "a.sog", one, overwrite=True)
        actual = read_gaussians(tmp_path / "a.sog").gaussians
        np.testing.assert_array_equal(actual.opacities, one.opacities)
        assert np.isfinite(actual.sh0).all()


def test_sog_textures_lose_nothing(gaussians: Gaussians) -> None:
    """Written again, what is read gives the same textures but for the rounding of rotations."""
    with zipfile.ZipFile(io.BytesIO(sog_bytes(gaussians))) as archive:
        meta = json.loads(archive.read("meta.json"))
        quats, labels = (
            cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_UNCHANGED)
            for name in ("quats.webp", "shN_labels.webp")
        )
    assert set(np.unique(quats.reshape(-1, 4)[: len(gaussians), 3])) <= {252, 253, 254, 255}
    places = labels.reshape(-1, 3)[: len(gaussians), ::-1].astype(int) @ (1, 256, 0)
    np.testing.assert_array_equal(places, np.arange(len(gaussians)))
    assert (meta["count"], meta["shN"]["bands"], len(meta["shN"]["codebook"])) == (len(gaussians), 3, 256)


def test_a_codebook_is_nearly_the_best_one() -> None:
    """Of a normal distribution, 256 codes at best leave pi sqrt(3) / 2 / 256^2 of the variance (Panter and Dite)."""
    values = np.random.default_rng(0).normal(size=200_000)
    codebook = fit_codebook(values)
    error = ((values - codebook[nearest_codes(codebook, values)]) ** 2).mean()
    assert error < 1.05 * np.pi * np.sqrt(3) / 2 / 256**2


def test_a_codebook_has_room_for_what_is_far_away() -> None:
    values = np.concatenate([np.random.default_rng(0).normal(size=10_000), [-400.0, 1e4]])
    codebook = fit_codebook(values)
    assert (codebook.shape, codebook[0], codebook[-1]) == ((256,), -400, 1e4)
    assert (np.diff(codebook) >= 0).all()


@pytest.mark.parametrize("values", [[], [3.0], [1.0, 2.0, 2.0]])
def test_few_values_are_their_own_codes(values: list[float]) -> None:
    codebook = fit_codebook(np.array(values))
    np.testing.assert_array_equal(codebook[nearest_codes(codebook, np.array(values))], values)
    assert codebook.shape == (256,)


def test_a_palette_stands_for_all_vectors() -> None:
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(16, 9))
    vectors = centres[rng.integers(0, 16, 1000)] + rng.normal(0, 1e-3, (1000, 9))
    palette, labels = fit_palette(vectors, 6)
    assert palette.shape == (64, 9)
    assert np.bincount(labels, minlength=64).min() >= 1000 // 64
    spread = np.abs(vectors - vectors.mean(0)).mean()
    assert np.abs(vectors - palette[labels]).mean() < spread / 4
    few, own = fit_palette(vectors, 10)
    np.testing.assert_array_equal(few[own], vectors)


def sog_with(change: Callable[[dict[str, Any], dict[str, bytes]], None]) -> bytes:
    """A .sog of three Gaussians whose meta.json and files were changed."""
    with zipfile.ZipFile(io.BytesIO(sog_bytes(corners()))) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files.pop("meta.json"))
    change(meta, files)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in {**files, "meta.json": json.dumps(meta).encode()}.items():
            archive.writestr(name, data)
    return content.getvalue()


def webp(height: int, width: int, *settings: int) -> bytes:
    return cv2.imencode(".webp", np.zeros((height, width, 3), np.uint8), settings)[1].tobytes()


def spz_with(**changes: int) -> bytes:
    names = ("magic", "version", "count", "degree", "fraction", "flags", "zero")
    data = gzip.decompress(spz_bytes(corners()))
    header = dict(zip(names, struct.unpack_from("<3I4B", data), strict=True)) | changes
    return gzip.compress(struct.pack("<3I4B", *header.values()) + data[16:])


LOSSLESS = (cv2.IMWRITE_WEBP_QUALITY, 101)
DAMAGED = {
    "empty.spz": b"",
    "text.spz": b"ply\n",
    "cut.spz": spz_bytes(corners())[:40],
    "short.spz": gzip.compress(gzip.decompress(spz_bytes(corners()))[:-1]),
    "other.spz": spz_with(magic=1),
    "later.spz": b"NGSP\4\0\0\0",
    "version.spz": spz_with(version=9),
    "degree.spz": spz_with(degree=4),
    "fraction.spz": spz_with(fraction=200),
    "none.spz": spz_with(count=0),
    "promise.spz": spz_with(count=2**32 - 1),
    "more.spz": spz_with(count=4),
    "empty.splat": b"",
    "odd.splat": bytes(33),
    "nan.splat": np.full(8, np.nan, "<f4").tobytes(),
    "empty.sog": b"",
    "text.sog": b"PK\3\4 and no more",
    "cut.sog": sog_bytes(corners())[:-9],
    "old.sog": sog_with(lambda meta, files: meta.pop("version") and None),
    "list.sog": sog_with(lambda meta, files: meta.update(version=[2])),
    "promise.sog": sog_with(lambda meta, files: meta.update(count=10**18)),
    "count.sog": sog_with(lambda meta, files: meta.update(count=17)),
    "word.sog": sog_with(lambda meta, files: meta.update(count="three\nlines")),
    "absent.sog": sog_with(lambda meta, files: files.pop("quats.webp") and None),
    "outside.sog": sog_with(lambda meta, files: meta["quats"].update(files=["../../etc/passwd"])),
    "codes.sog": sog_with(lambda meta, files: meta["sh0"].update(codebook=[0.5])),
    "huge.sog": sog_with(lambda meta, files: meta["means"].update(mins=[10**400] * 3)),
    "nan.sog": sog_with(lambda meta, files: meta["means"].update(mins=[float("nan")] * 3)),
    "lossy.sog": sog_with(lambda meta, files: files.update({"scales.webp": webp(4, 4, cv2.IMWRITE_WEBP_QUALITY, 50)})),
    "pixels.sog": sog_with(lambda meta, files: files.update({"scales.webp": webp(4096, 4096, *LOSSLESS)})),
    "mode.sog": sog_with(lambda meta, files: files.update({"quats.webp": files["sh0.webp"]})),
    "header.sog": sog_with(lambda meta, files: files.update({"scales.webp": files["scales.webp"][:25]})),
    "harmonics.sog": sog_with(lambda meta, files: meta.update(shN={"count": 10**9, "bands": 3, "files": ["a", "b"]})),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_end_with_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    path.write_bytes(DAMAGED[name])
    with pytest.raises(SceneError):
        read_gaussians(path)
    assert main(["inspect", str(path)]) == 3
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert name in captured.err


def test_noise_in_a_file_is_no_traceback(tmp_path: Path) -> None:
    """Bytes changed at random either still give Gaussians, or one of our errors."""
    rng, path, refused = np.random.default_rng(0), tmp_path, 0
    for content, ending in ((spz_bytes(corners()), ".spz"), (sog_bytes(corners()), ".sog")):
        path = tmp_path / f"a{ending}"
        for _ in range(150):
            data = bytearray(content)
            for at in rng.integers(0, len(data), rng.integers(1, 4)):
                data[at] = rng.integers(0, 256)
            path.write_bytes(data)
            try:
                assert len(read_gaussians(path).gaussians) > 0
            except SceneError:
                refused += 1
    assert refused > 100
