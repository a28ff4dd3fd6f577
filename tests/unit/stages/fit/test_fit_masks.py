"""Parts of photos that the full fit is told not to look at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge.render.photos import Photos
from gsmerge.stages.fit import FitOptions
from gsmerge.stages.fit.full import fit_full


@pytest.mark.parametrize("coarse", [0.5, 1.0])
def test_steps_do_not_look_where_the_mask_is_not(coarse: float) -> None:
    """Rubbish on the left third of every photo; at both sizes, and at half size alone."""
    scene, truth = scenes.self_made(0)
    start = scenes.spoil(truth)
    options = FitOptions(fit_steps=40, holdout=0.2, half_res_share=coarse, dropout=0.0)

    def spoilt(photos: Photos) -> Photos:
        images = photos.images.copy()
        images[:, :, : photos.width // 3] = (1, 0, 1)
        return replace(photos, images=images)

    rubbish = tuple(map(spoilt, scenes.pair_of(scene)))
    masks = tuple(np.ones(photos.images.shape[:3], bool) for photos in rubbish)
    for mask in masks:
        mask[:, :, : mask.shape[2] // 3] = False
    whole, _ = fit_full(start, rubbish, options)  # type: ignore[arg-type]
    masked, report = fit_full(start, rubbish, options, masks=masks)  # type: ignore[arg-type]
    again, _ = fit_full(start, rubbish, options, masks=tuple(np.ones_like(mask) for mask in masks))  # type: ignore[arg-type]
    assert report.accepted
    assert scenes.psnr_of(masked, scene) > scenes.psnr_of(whole, scene) + 2
    assert np.array_equal(again.means, whole.means)
