"""The Feature Gaussians of a state as plain arrays in the world's frame, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from gsmerge.io import atomic_output
from gsmerge.io.archives import new_member
from gsmerge.pooling import feature_to_gaussians
from gsmerge.report import document_head
from gsmerge.runtime.memory import human_bytes
from gsmerge.states.state import DividedGroups, State
from gsmerge.states.state_file import load_state

ENDING = ".npz"


def feature_arrays(state: State) -> dict[str, np.ndarray]:
    """Return what a state holds of its g Feature Gaussians and v views, by name, in the world's frame and unit.

    docs/reference/formats.md says what each array is, with its shape and unit.
    """
    groups, learned, unit = state.groups, state.groups.learned, state.frame.unit
    heads = groups.heads if isinstance(groups, DividedGroups) else None
    features = groups.features if learned is None else learned.refined
    views = next((part.views for part in (learned, heads) if part is not None), features.views)
    ones, cameras = state.frame.leave(feature_to_gaussians(features)), state.frame.leave_cameras(state.cameras)
    arrays = {
        **{name: np.asarray(column) for name, column in vars(ones).items()},
        "covars": features.covars.astype(np.float64) * unit**2,
        "weights": features.weights,
        "masses": features.masses.astype(np.float64) * unit**3,
        "extinctions": features.extinctions.astype(np.float64) * unit**2,
        "gains": features.gains,
        "footprints": features.footprints.astype(np.float64) * unit,
        "latents": np.asarray(features.latents),
        "views": views,
        "viewmats": cameras.viewmats,
        "Ks": cameras.Ks,
        "size": np.array([cameras.width, cameras.height]),
    }
    if groups.saliency is not None:
        arrays["saliency"] = groups.saliency
    if learned is not None:
        arrays["num_members"] = learned.num_members
    elif groups.colors is not None:
        arrays["fitted_sh0"] = groups.colors.sh0
    return arrays


def convert_state(path: Path, out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the Feature Gaussians of the state in a file as an ``.npz``; return the report as plain JSON types.

    Raises SceneError if a file cannot be read or written.
    """
    state = load_state(path)
    arrays = feature_arrays(state)
    with atomic_output(out, overwrite=overwrite) as temporary, ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            with archive.open(new_member(f"{name}.npy"), "w", force_zip64=True) as file:
                np.save(file, array, allow_pickle=False)
    before = {"path": str(path), "bytes": path.stat().st_size, "num_gaussians": state.settings.num_input}
    after = {"path": str(out), "bytes": out.stat().st_size, "num_groups": len(state), "format": ENDING}
    after["arrays"] = {name: list(array.shape) for name, array in arrays.items()}
    return document_head() | {"inputs": [before], "left_out": {}, "output": after, "viewer_cameras": None, "notes": []}


def conversion_line(document: dict[str, Any]) -> str:
    """Describe the report of :func:`convert_state` in one line."""
    after = document["output"]
    return f"{after['path']}: {after['num_groups']:,} Feature Gaussians, {human_bytes(after['bytes'])}"
