"""A ``.sog`` has textures without loss, and codebooks and palettes that stand for many values."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
from messages import refuses
from slow_readers import corners, drawn

from gsmerge import Gaussians
from gsmerge.errors import SceneError
from gsmerge.io import read_gaussians, write_gaussians
from gsmerge.io.formats.sog import fit_codebook, fit_palette, nearest_codes, sog_bytes
from gsmerge.reading.scene_files import find_scene_files


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return drawn(scenes.make_scene(scenes.room(), scenes.arc(3, 96, 72)), 3)


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_a_sog_keeps_opacities_of_zero_or_one(opacity: float, tmp_path: Path) -> None:
    """Where every alpha is 255, or 0, WebP stores no alpha, or no colours."""
    one = replace(corners(), opacities=np.full(3, opacity, np.float32))
    write_gaussians(tmp_path / "a.sog", one, overwrite=True)
    actual = read_gaussians(tmp_path / "a.sog").gaussians
    np.testing.assert_array_equal(actual.opacities, one.opacities)
    assert np.isfinite(actual.sh0).all()


def test_textures_of_a_sog_are_stored_without_loss(gaussians: Gaussians) -> None:
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


def test_a_sog_that_was_unpacked_is_read(gaussians: Gaussians, tmp_path: Path) -> None:
    """By the path of its ``meta.json``, or of the folder."""
    write_gaussians(tmp_path / "a.sog", gaussians)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "a")
    expected, actual = (read_gaussians(tmp_path / name) for name in ("a.sog", "a/meta.json"))
    for column, other in zip(vars(expected.gaussians).values(), vars(actual.gaussians).values(), strict=True):
        np.testing.assert_array_equal(column, other)
    assert actual.info.file_bytes == sum(path.stat().st_size for path in (tmp_path / "a").iterdir())
    assert find_scene_files(tmp_path / "a").ply == tmp_path / "a" / "meta.json"
    assert read_gaussians(tmp_path / "a").info == actual.info


def test_a_compressed_checkpoint_of_gsplat_is_named(tmp_path: Path) -> None:
    """Its PngCompression writes a meta.json without a version, as .sog version 1 has; that names its files."""
    values = {"shape": [9, 3], "dtype": "float32", "mins": [0.0] * 3, "maxs": [1.0] * 3}
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    meta = tmp_path / "meta.json"
    meta.write_text(json.dumps(dict.fromkeys(names, values)))
    for path in (tmp_path, meta):
        with refuses(SceneError, meta, "gsplat", "PngCompression", "save_ply"):
            read_gaussians(path)
    meta.write_text(json.dumps({name: values | {"files": [f"{name}.webp"]} for name in names}))
    with refuses(SceneError, meta, "found 1"):
        read_gaussians(meta)


def test_a_codebook_is_nearly_the_best_one() -> None:
    """Of a normal distribution, 256 codes at best leave pi sqrt(3) / 2 / 256^2 of the variance (Panter and Dite)."""
    values = np.random.default_rng(0).normal(size=200_000)
    codebook = fit_codebook(values)
    error = ((values - codebook[nearest_codes(codebook, values)]) ** 2).mean()
    assert error < 1.05 * np.pi * np.sqrt(3) / 2 / 256**2


def test_a_codebook_includes_values_far_away() -> None:
    values = np.concatenate([np.random.default_rng(0).normal(size=10_000), [-400.0, 1e4]])
    codebook = fit_codebook(values)
    assert (codebook.shape, codebook[0], codebook[-1]) == ((256,), -400, 1e4)
    assert (np.diff(codebook) >= 0).all()


@pytest.mark.parametrize("values", [[], [3.0], [1.0, 2.0, 2.0]])
def test_few_values_are_their_own_codes(values: list[float]) -> None:
    codebook = fit_codebook(np.array(values))
    np.testing.assert_array_equal(codebook[nearest_codes(codebook, np.array(values))], values)
    assert codebook.shape == (256,)


def test_a_palette_is_near_all_of_its_vectors() -> None:
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(16, 9))
    vectors = centres[rng.integers(0, 16, 1000)] + rng.normal(0, 1e-3, (1000, 9))
    palette, labels = fit_palette(vectors, 6)
    assert palette.shape == (64, 9)
    assert np.bincount(labels, minlength=64).min() >= 1000 // 64
    spread = np.abs(vectors - vectors.mean(0)).mean()
    assert np.abs(vectors - palette[labels]).mean() < spread / 4  # far nearer than the mean of all
    few, own = fit_palette(vectors, 10)
    np.testing.assert_array_equal(few[own], vectors)
