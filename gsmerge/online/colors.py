"""The colours of what a batch shows, solved for its photos and for what earlier photos said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsmerge.moments import feature_to_gaussians
from gsmerge.online.cover import rows_in_view
from gsmerge.online.pictures import Shots
from gsmerge.online.state import Parts, pick, swapped
from gsmerge.render.weights import apply_transposed
from gsmerge.stages.fit import FitReport
from gsmerge.stages.fit.color import draw, fit_colors
from gsmerge.stages.fit.options import FitOptions


def solve_colors(parts: Parts, shots: Shots, options: FitOptions, seed: int = 0) -> tuple[Parts, FitReport]:
    """Base colours that fit new photos, held back by those that each was fitted to before.

    The normal equations of earlier photos are kept as their diagonal (``Parts.held``) about the colours that solve
    them: what is added to the equations of the new photos is ``held |colour - present colour|^2``, and no earlier photo
    is needed again.

    Args:
        parts: The state's groups.
        shots: The new photos.
        options: Of the colour fit.
        seed: Chooses the held-out blocks.

    Returns:
        The groups, with the new photos in what they are held by, and what was done. Where held-out blocks did not get
        better the new photos speak for the colours that are there, and hold those.
    """
    rows = rows_in_view(parts.features, shots.cameras)
    part, photos = pick(parts, rows), shots.photos(2)
    before = replace(feature_to_gaussians(part.features), sh0=part.solved)
    drawn = draw(before, photos)
    after, report = fit_colors(before, drawn, photos, options, seed, part.held.numpy())
    everywhere = np.ones((photos.height, photos.width, 1), np.float32)
    held = part.held.double().numpy()
    for view in drawn.views:
        held[view.ids] += apply_transposed(replace(view, weights=view.weights**2), everywhere)[:, 0]
    return swapped(parts, rows, replace(part, solved=after.sh0, held=torch.from_numpy(held).float())), report
