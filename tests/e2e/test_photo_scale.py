"""Photos twice as large as the grid make it sharper from near, as good at its own size (floors.csv, dB)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from floors import nudged

import gsmerge
from gsmerge.io import read_images
from gsmerge.method.geometry.views import resize_cameras
from gsmerge.method.raster.metrics import psnr
from gsmerge.research.generate import GenerateOptions, NoiseOptions, generate_scene
from gsmerge.scoring.sizes import resize_photo

Floor = Callable[..., None]
NUM_VIEWS, SUPERPIXELS = 5, 256
ERRORS = NoiseOptions(sh_degrees=(0,), constant_opacity=0.0, unit=(1.0, 1.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene of 96 x 64 with photos and targets of 192 x 128. Read only."""
    options = GenerateOptions(views=NUM_VIEWS, width=96, height=64, ranges=ERRORS, photo_scale=2)
    out = generate_scene(tmp_path_factory.mktemp("large") / "scene", options, seed=2)
    ply = out / "scene.ply"
    gsmerge.write_ply(ply, nudged(gsmerge.read_ply(ply).gaussians), overwrite=True)
    return out


def scores(folder: Path, ply: Path) -> tuple[float, float]:
    """Return the PSNR (dB) of the targets at the grid's size and at twice that."""
    targets, gaussians = folder / "targets", gsmerge.read_ply(ply).gaussians
    camera_file = gsmerge.read_cameras(targets)
    photos, values = read_images(targets, camera_file.names), []
    stored = gsmerge.to_cameras(camera_file)
    for parts in (2, 1):
        cameras = resize_cameras(stored, stored.width // parts, stored.height // parts)
        images = gsmerge.render(gaussians, cameras).images.clip(0, 1)
        pairs = zip(images, photos, strict=True)
        values.append(np.mean([psnr(a, resize_photo(b, cameras.width, cameras.height)) for a, b in pairs]))
    return float(values[0]), float(values[1])


@pytest.mark.slow
def test_larger_photos_make_the_result_sharper(
    folder: Path, tmp_path: Path, run: Callable[..., Any], floor: Floor
) -> None:
    documents, values = [], []
    for name, options in (("own", ("--set", "photo_scale=1")), ("large", ())):
        out = tmp_path / f"{name}.ply"
        done = run("compact", folder, "-o", out, "--set", f"superpixels={SUPERPIXELS}", "--json", *options, code=0)
        documents.append(json.loads(done.out))
        values.append(scores(folder, out))
    own, large = documents
    asked = [document["output"]["num_gaussians"] + document["choices"]["pruned"] for document in documents]
    assert asked == [NUM_VIEWS * SUPERPIXELS] * 2
    assert "photo_scale" not in own["choices"]
    assert large["choices"]["photo_scale"] == 2
    assert any("192 x 128" in note for note in large["notes"])
    floor(values[1][1], "near")
    floor(values[1][1] - values[0][1], "near over the grid's size alone")
    floor(values[1][0], "at the grid's size")
