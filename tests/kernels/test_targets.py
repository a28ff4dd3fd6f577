"""Blending and its backward pass write the same bits with eight lanes as with sixteen."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from targets import runnable_targets

# Gaussians of all shapes, in front of each other, in pictures that end inside of tiles
CODE = """
import hashlib
import numpy as np
from gsmerge import Cameras, Gaussians
from gsmerge.method.raster import composite, make_splats, tile_view
from gsmerge.method.raster.gradient import gradients_of

rng = np.random.default_rng(5)
for width, height, count, reach in ((37, 45, 400, -1.5), (64, 16, 3000, -2.5), (130, 70, 2000, 0.0)):
    scales = 10 ** rng.uniform(reach - 1, reach, (count, 3))
    means = rng.normal(0, 0.8, (count, 3)) + [0, 0, 3]
    opacities, colors = rng.uniform(0.01, 1, count), rng.random((count, 3))
    parts = means, rng.normal(size=(count, 4)), scales, opacities, rng.random((count, 1, 3)), np.zeros((count, 0, 3))
    gaussians = Gaussians(*(part.astype(np.float32) for part in parts))
    K = np.array([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]])
    tiled = tile_view(make_splats(gaussians), np.eye(4), K[0], width, height)
    image, left = composite(tiled, colors.astype(np.float32), np.array([0.2, 0.5, 0.9], np.float32))
    gradient = rng.normal(size=image.shape).astype(np.float32)
    back = gradients_of(tiled, colors.astype(np.float32)[tiled.ids], image, left, gradient, left, True)
    for array in (image, left, back.means, back.quats, back.scales, back.opacities, back.colors):
        print(hashlib.sha256(np.ascontiguousarray(array)).hexdigest(), float(np.abs(array).sum()) > 0)
"""


def digests(target: str) -> list[str]:
    env = os.environ | {"GSMERGE_TARGET": target}
    done = subprocess.run([sys.executable, "-c", CODE], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_every_target_writes_the_same_bits() -> None:
    first, *others = runnable_targets()
    if not others:
        pytest.skip("this processor runs one target")
    expected = digests(first)
    assert len(expected) == 21
    assert all(line.endswith("True") for line in expected)
    assert all(digests(other) == expected for other in others)
