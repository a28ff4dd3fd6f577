"""Settings of the fit."""

from __future__ import annotations

import pytest

from gsmerge.stages.fit.options import STEPS, FitOptions


@pytest.mark.parametrize(("share", "steps"), [(0.001, 240), (0.044, 240), (0.088, 339), (0.176, 480), (1.0, 480)])
def test_more_gaussians_get_more_steps(share: float, steps: int) -> None:
    assert FitOptions().with_steps_for(share).steps == steps


def test_steps_that_are_given_stay() -> None:
    given = FitOptions(fit_steps=7)
    assert given.with_steps_for(1.0) is given


def test_more_steps_begin_as_the_effort_does() -> None:
    """With all Gaussians, or with some of them: what runs before the fit has chosen by the effort already."""
    for effort in STEPS:
        usual, most = FitOptions(effort=effort), FitOptions(effort=effort).with_steps_for(1.0)
        assert most.grows == usual.grows
