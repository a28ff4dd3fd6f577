"""Cases of the stress test: how a scene is changed, which scenes they are for, and the property that must hold.

Every change returns a new scene and applies to the views that results are compared with, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import cv2
import numpy as np

from gsmerge.facts.align_views import move_views
from gsmerge.facts.prepare import scene_frame
from gsmerge.facts.views import even_views, subset
from gsmerge.io.cameras.camera_file import CONVENTIONS
from gsmerge.types import SH_C0, Cameras, Scene, Views, grid_ids

Needs = Literal["anything", "pixels", "photos", "file", "pixel-file"]
Check = Literal["better", "same", "near", "once", "bits", "again", "convention", "moved", "refused"]

UTM = (4.0e5, 5.0e6, 100.0)  # metres, as in map coordinates

PROPERTIES: dict[Check, str] = {
    "better": "not below its own input by more than {worse:g} dB",
    "same": "as many Gaussians within 0.5 %, not more than {same:g} dB below the unchanged scene",
    "near": "not more than {near:g} dB below the unchanged scene",
    "once": "at most 1.05 times the Gaussians, not more than {same:g} dB below the unchanged scene",
    "bits": "the same result, bit for bit",
    "again": "compacted again to the same count, not more than {same:g} dB below",
    "convention": "recognised, with every Gaussian at its pixel, or refused in one line",
    "moved": "read with cameras moved to where every view's Gaussians lie in their pixels",
    "refused": "refused in one line",
}
SEED = 7  # of all random choices
FAR_SHARE = 2.5e-5  # share of the Gaussians that are moved far away
LARGE_SHARE, LARGE_FACTOR = 0.01, 8.0  # share of the Gaussians that are enlarged, and the factor
BROKEN_SHARE = 0.01  # share of the rows that become NaN


@dataclass(frozen=True)
class StressScene:
    """A scene and the views that its results are compared with."""

    scene: Scene
    views: Views | None  # held-out views in its world; None: its own views


def keep_views(given: StressScene, choose: Callable[[int], Sequence[int]]) -> StressScene:
    """Keep the views that ``choose`` lists, given their number."""
    return replace(given, scene=subset(given.scene, choose(len(given.scene))))


def move(given: StressScene, factor: float, shift: Sequence[float]) -> StressScene:
    """Scale the world, and move it by ``shift`` in units of its own size."""
    offset = np.array(shift, np.float64) * scene_frame(given.scene).unit * factor
    scene, views = given.scene, given.views
    means = factor * scene.gaussians.means.astype(np.float64) + offset
    gaussians = replace(scene.gaussians, means=means, scales=scene.gaussians.scales * factor)
    scene = replace(scene, gaussians=gaussians, cameras=_move_cameras(scene.cameras, factor, offset))
    if views is not None:
        views = replace(views, cameras=_move_cameras(views.cameras, factor, offset))
    return StressScene(scene, views)


def _move_cameras(cameras: Cameras, factor: float, offset: np.ndarray) -> Cameras:
    viewmats = cameras.viewmats.astype(np.float64)
    viewmats[:, :3, 3] = factor * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ offset
    return replace(cameras, viewmats=viewmats)


def perturb_poses(given: StressScene, degrees: float) -> StressScene:
    """Rotate every view, with its Gaussians, about its camera centre by a random axis."""
    scene = given.scene
    viewmats = turn_cameras(scene.cameras.viewmats.astype(np.float64), degrees, slice(None))
    return replace(given, scene=move_views(scene, viewmats))


def move_view(given: StressScene, share: float) -> StressScene:
    """Move the middle view, with its Gaussians, sideways by a share of the scene's size."""
    scene = given.scene
    view, viewmats = len(scene) // 2, scene.cameras.viewmats.astype(np.float64)
    step = viewmats[view, 0, :3] * share * scene_frame(scene).unit
    viewmats[view, :3, 3] -= viewmats[view, :3, :3] @ step
    return replace(given, scene=move_views(scene, viewmats))


def turn_cameras(viewmats: np.ndarray, degrees: float, views: slice) -> np.ndarray:
    """Turn some cameras, without their Gaussians, about their centres, each about another axis."""
    turned, rng = viewmats.copy(), np.random.default_rng(SEED)
    for view in range(len(viewmats))[views]:
        axis = rng.normal(size=3)
        turned[view, :3] = cv2.Rodrigues(np.deg2rad(degrees) * axis / np.linalg.norm(axis))[0] @ viewmats[view, :3]
    return turned


def change_exposure(given: StressScene, share: float) -> StressScene:
    """Make photos, and the Gaussians of their views, alternately brighter and darker."""
    scene = given.scene
    assert scene.images is not None
    gains = np.array([1 + share if view % 2 else 1 - share for view in range(len(scene))], np.float32)
    rows = gains.repeat(scene.pixels_per_view)[:, None, None]
    g = scene.gaussians
    sh0 = ((0.5 + SH_C0 * g.sh0) * rows - 0.5) / SH_C0
    gaussians = replace(g, sh0=sh0, shN=g.shN * rows)
    images = (scene.images * gains[:, None, None, None]).clip(0, 1)
    return replace(given, scene=replace(scene, gaussians=gaussians, images=images, large_photos=None))


def break_rows(given: StressScene) -> StressScene:
    """Take away the finite numbers of some rows, which the reader leaves out."""
    scene = given.scene
    chosen = _choose(len(scene.gaussians), BROKEN_SHARE)
    if not scene.aligned:
        return replace(given, scene=replace(scene, gaussians=scene.gaussians[~chosen]))
    gaussians = replace(scene.gaussians, opacities=np.where(chosen, np.float32(0), scene.gaussians.opacities))
    valid = scene.valid & ~chosen.reshape(scene.valid.shape)
    return replace(given, scene=replace(scene, gaussians=gaussians, pixel_ids=grid_ids(valid)))


def throw_away(given: StressScene) -> StressScene:
    """Move a few Gaussians a thousand times as far away."""
    scene = given.scene
    chosen = _choose(len(scene.gaussians), FAR_SHARE)[:, None]
    means = np.where(chosen, 1000 * scene.gaussians.means, scene.gaussians.means)
    return replace(given, scene=replace(scene, gaussians=replace(scene.gaussians, means=means)))


def enlarge(given: StressScene) -> StressScene:
    """Make some Gaussians many times as large."""
    gaussians = given.scene.gaussians
    chosen = _choose(len(gaussians), LARGE_SHARE)[:, None]
    scales = np.where(chosen, LARGE_FACTOR * gaussians.scales, gaussians.scales)
    return replace(given, scene=replace(given.scene, gaussians=replace(gaussians, scales=scales)))


def _choose(count: int, share: float) -> np.ndarray:
    """Mark a random share of the rows, ``[count]`` bool, at least one."""
    chosen = np.zeros(count, bool)
    chosen[np.random.default_rng(SEED).choice(count, max(1, round(share * count)), replace=False)] = True
    return chosen


@dataclass(frozen=True)
class Case:
    """One bad condition."""

    name: str  # on the command line
    words: str  # the change in words
    check: Check  # which property must hold, see ``PROPERTIES``
    # "pixels": one Gaussian per pixel; "photos": that and photos; "file": a scene with cameras in a file; "pixel-file":
    # that and one Gaussian per pixel
    needs: Needs = "anything"
    # returns the changed scene; None: the scene stays, the run differs
    change: Callable[[StressScene], StressScene] | None = None
    threads: int | None = None  # threads of the run; None: as in the options
    convention: tuple[str, str] | None = None  # pose convention to write, in the terms of camera files
    cameras: Callable[[np.ndarray], np.ndarray] | None = None  # changes the viewmats of the camera file alone


def _rewrite_poses(direction: str, axes: str) -> Case:
    """Make a case of poses in another convention, such as "c2w-opencv" of "camera-to-world" and "OpenCV"."""
    name = direction[0] + "2" + direction.split("-")[2][0] + "-" + axes.lower()
    return Case(name, f"poses written {direction}, {axes} axes", "convention", "file", convention=(direction, axes))


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("unchanged", "the scene as it is", "better"),
        Case("views-half", "half of the views", "better", "pixels",
             partial(keep_views, choose=lambda num: even_views(num, max(1, num // 2)))),
        Case("views-3", "three views", "better", "pixels",
             partial(keep_views, choose=lambda num: even_views(num, min(3, num)))),
        Case("views-1", "one view", "better", "pixels", partial(keep_views, choose=lambda num: even_views(num, 1))),
        Case("order", "views in another order", "same", "pixels",
             partial(keep_views, choose=lambda num: np.random.default_rng(SEED).permutation(num).tolist())),
        Case("twice", "every view twice", "once", "pixels",
             partial(keep_views, choose=lambda num: [*range(num)] * 2)),
        Case("poses-0.2", "poses 0.2 degrees off", "better", "photos", partial(perturb_poses, degrees=0.2)),
        Case("poses-1", "poses 1 degree off", "better", "photos", partial(perturb_poses, degrees=1.0)),
        Case("poses-5", "poses 5 degrees off", "better", "photos", partial(perturb_poses, degrees=5.0)),
        Case("view-moved", "one view 2 % of the depth aside", "near", "photos", partial(move_view, share=0.02)),
        Case("cameras-0.5", "cameras 0.5 degrees off, not their Gaussians", "moved", "pixel-file",
             cameras=partial(turn_cameras, degrees=0.5, views=slice(None))),
        Case("camera-far", "one camera 15 degrees off", "refused", "pixel-file",
             cameras=partial(turn_cameras, degrees=15.0, views=slice(1))),
        Case("exposure", "exposure +-20 % by turns", "better", "photos", partial(change_exposure, share=0.2)),
        Case("utm", "moved to map coordinates", "same", "anything", partial(move, factor=1.0, shift=UTM)),
        Case("small", "scaled by 1e-4", "same", "anything", partial(move, factor=1e-4, shift=(0, 0, 0))),
        Case("large", "scaled by 1e4", "same", "anything", partial(move, factor=1e4, shift=(0, 0, 0))),
        Case("broken", "1 % of the rows not finite", "near", "anything", break_rows),
        Case("flyaways", "0.0025 % of the Gaussians far away", "near", "anything", throw_away),
        Case("oversized", "1 % of the Gaussians 8 times as large", "near", "anything", enlarge),
        Case("threads", "one thread", "bits", threads=1),
        Case("again", "the result compacted once more", "again"),
        *(_rewrite_poses(*convention) for convention in CONVENTIONS),
    )
}  # fmt: skip
