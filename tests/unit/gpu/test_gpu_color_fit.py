"""The colour fit on a device is that of the stage."""

from __future__ import annotations

from typing import Any

import pytest
from gpu_runs import ON_TORCH, Pair, assert_close, gpu

from gsmerge import Gaussians
from gsmerge.gpu import choose_backend
from gsmerge.stages.fit import ON_CPU, FitOptions, FitReport
from gsmerge.stages.fit.stage import FitBackend


def colored(start: Gaussians, photos: Pair, backend: FitBackend[Any]) -> tuple[Gaussians, FitReport]:
    result, report = backend.fit_colors(backend.upload(start), backend.upload_photos(photos[1]), FitOptions(), 0)
    return backend.download(result), report


def test_colors_are_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, report = colored(start, photos, ON_TORCH)
    expected, other = colored(start, photos, ON_CPU)
    assert_close(actual, expected, 1e-4)
    assert (report.method, report.accepted) == (other.method, other.accepted) == ("color", True)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=1e-4)


@gpu
def test_colors_of_a_gpu_are_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, _ = colored(start, photos, choose_backend("cuda", 0)[0])
    assert_close(actual, colored(start, photos, ON_CPU)[0], 0.05)
