"""The colour fit on a device is that of the stage."""

from __future__ import annotations

import pytest
from gpu_runs import ON_TORCH, Pair, assert_close, gpu

from gsmerge import Gaussians
from gsmerge.gpu import choose_backend
from gsmerge.stages.fit import FitOptions, fit

COLOR = FitOptions(fit="color")


def test_colors_are_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, report = fit(start, photos, COLOR, backend=ON_TORCH)
    expected, other = fit(start, photos, COLOR)
    assert_close(actual, expected, 1e-4)
    assert report is not None
    assert other is not None
    assert (report.method, report.accepted) == (other.method, other.accepted) == ("color", True)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=1e-4)


@gpu
def test_colors_of_a_gpu_are_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, _ = fit(start, photos, COLOR, backend=choose_backend("cuda", 0)[0])
    assert_close(actual, fit(start, photos, COLOR)[0], 0.05)
