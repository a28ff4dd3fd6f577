"""Gaussians left out of single steps of the full fit, so that few photos are not learnt by heart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.render.photos import Photos
from gsmerge.stages.fit import FitOptions
from gsmerge.stages.fit import full as full_module
from gsmerge.stages.fit.fit_options import LONG_STEPS
from gsmerge.stages.fit.fit_state import start_state
from gsmerge.stages.fit.full import fit_full, plan_run

QUICK = FitOptions(fit_steps=30, holdout=0.2)
LONG = FitOptions(fit_steps=160, holdout=0.2)


def test_dropout_where_there_are_few_views(photos: tuple[Photos, Photos]) -> None:
    many = Photos(*(np.concatenate([a, a]) for a in (photos[0].images, photos[0].viewmats, photos[0].Ks)), eps2d=0.3)
    pair = many, replace(photos[1], images=np.concatenate([photos[1].images] * 2))
    assert len(photos[0]) <= full_module.FEW_VIEWS < len(many)
    assert plan_run(photos, LONG, 0).dropout == full_module.DROPOUT > 0
    assert plan_run(photos, replace(LONG, fit_steps=full_module.MANY_STEPS - 1), 0).dropout == 0
    assert plan_run(pair, LONG, 0).dropout == 0
    assert plan_run(pair, replace(LONG, dropout=0.15), 0).dropout == 0.15
    assert plan_run(photos, replace(LONG, dropout=0.0), 0).dropout == 0
    very_long = replace(LONG, fit_steps=LONG_STEPS)
    assert 0 < plan_run(pair, very_long, 0).dropout < plan_run(photos, very_long, 0).dropout
    assert very_long.half_res_part < LONG.half_res_part < replace(LONG, half_res_share=0.9).half_res_part


def test_dropout_leaves_out_its_share(truth: Gaussians, photos: tuple[Photos, Photos]) -> None:
    """What is left out learns nothing from the step."""
    moved = []
    for share in (0.0, 0.5):
        state, plan = start_state(truth), plan_run(photos, replace(QUICK, dropout=share), 0)
        full_module.fit_step(state, plan, 1, 1, 0.0, np.random.default_rng(0))
        moved.append(state.m.any(1).mean())
    assert moved[0] > 0.6
    assert moved[1] == pytest.approx(0.5 * moved[0], abs=0.1)


def test_dropout_changes_the_run_and_still_helps(truth: Gaussians, photos: tuple[Photos, Photos]) -> None:
    start = scenes.spoil(truth)
    one, other = (fit_full(start, photos, replace(QUICK, dropout=share)) for share in (0.0, 0.3))
    assert one[1].accepted
    assert other[1].accepted
    assert not scenes.identical(one[0], other[0])
