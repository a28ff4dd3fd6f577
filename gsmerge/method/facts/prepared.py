"""A prepared scene: the scene in its canonical frame, as the stages use it, with facts about it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, cast

import numpy as np

from gsmerge.frozen import dataclass, field, replace
from gsmerge.method.facts.agreement import Agreement
from gsmerge.method.facts.pictures import PHOTOS, RENDERS
from gsmerge.method.facts.scene_size import SceneSize, measure_size, unlike_captures
from gsmerge.method.geometry.frame import Frame, sample_rows
from gsmerge.method.viewpoints.place_cameras import draw_around
from gsmerge.types import Cameras, PicturedScene, Scene

LEAST_VIEWS = 4  # fewest views with photos of which some are left out; of fewer views, too little would remain
FLAT = 2 / 255  # a picture shows one flat colour if the range of its values is smaller


@dataclass(frozen=True, eq=False)
class Reference:
    """Which pictures of a canonical scene a result is fitted to and scored on."""

    name: str  # "photos", or the name of the pictures that replace them; "" until they are chosen
    score_views: tuple[int, ...]  # Views whose pictures results are scored on
    # True if the scene has no views, so that all views are placed; no fit sees the views for scores
    placed: bool = False
    # [v,h,w,3] unchanged photos of the input scene, if the run changed some of them
    photo_files: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def of_views(self) -> bool:
        """Return whether pictures are chosen that are photos or the colours of the views' Gaussians, not renders."""
        return self.name not in ("", RENDERS)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in its canonical frame, as the stages use it, with facts about it.

    The steps of :mod:`gsmerge.prepare.steps` make one of another. After the last step all facts are known.
    """

    input_scene: Scene  # The scene as it was read, in its own world frame, with photos that look like its Gaussians
    # The canonical scene with pixels. It has every view once, and photos that do not show it are replaced
    scene: PicturedScene
    frame: Frame  # The canonical frame
    reference: Reference  # Use of the pictures
    repeated: tuple[int, ...]  # Index in the canonical scene of every view of the input scene
    moved: bool  # True if views were moved to poses at which their photos agree, before a fit or by it
    agreement: Agreement | None = None  # Shares of depth that views confirm; None if views cannot be compared
    # [v,h,w] bool, pixels of which photos and Gaussians are no part of the scene; None if there are none
    foreign: np.ndarray | None = None
    changes: tuple[str, ...] = ()  # What was done to photos, cameras and Gaussians, a sentence for each step

    def after(self, *changes: str, scene: Scene, **facts: Any) -> Prepared:
        """Return a copy with another scene and other facts after a step; ``changes`` say what it did, "" for nothing.

        Until the pictures are chosen, a scene may have none.
        """
        said = (*self.changes, *filter(None, changes))
        return replace(self, scene=cast("PicturedScene", scene), changes=said, **facts)

    @property
    def size(self) -> SceneSize:
        """Sizes of the scene that the plan depends on."""
        given_views = self.input_scene if self.reference.placed else self.scene  # placed views do not count
        size = measure_size(given_views, rendered=not self.reference.of_views)
        # Gaussians that fill holes do not count, because they are not in the file
        return replace(size, num_gaussians=min(size.num_gaussians, self.input_scene.num_gaussians))

    @property
    def can_leave_out(self) -> bool:
        """Return whether photos can be left out with their Gaussians, to score what the other views make.

        Enough views have photos, and each Gaussian comes from one view. Gaussians that views share would keep the
        content of the left-out photos; a trial in which they keep it has an error of 2 dB instead of 1.2 dB.
        """
        has_photos = self.reference.name == PHOTOS and len(self.reference.score_views) >= LEAST_VIEWS
        return has_photos and self.scene.has_own_pixels

    @cached_property
    def doubt(self) -> str | None:
        """Why scores of the scene and its results mean nothing, in one sentence; None if scores are meaningful."""
        unlike = unlike_captures(self.scene.gaussians[sample_rows(self.scene)])
        if unlike is not None:
            return unlike
        views = list(self.reference.score_views)
        if views and self.reference.name == RENDERS and all(np.ptp(self.scene.images[view]) < FLAT for view in views):
            return "the views show one flat colour, so no score can say how near a result is to the scene"
        return None

    @cached_property
    def scene_around(self) -> PicturedScene:
        """The canonical scene with more renders, from places around its views, which a fit to renders needs."""
        return draw_around(self.scene)

    def with_cameras(self, cameras: Cameras) -> Prepared:
        """Return a copy with the canonical cameras that a fit has moved."""
        if cameras is self.scene.cameras:
            return self
        return replace(self, scene=replace(self.scene, cameras=cameras), moved=True)

    def result_views(self) -> Scene:
        """Return the input scene with the corrected photos, in a common exposure, that a result should match."""
        return with_photos(self.input_scene, self.scene, self.repeated)

    def final_cameras(self) -> Cameras:
        """Return the input views' cameras in the world, with the poses that the fit has moved."""
        cameras = self.input_scene.cameras
        if not self.moved:
            return cameras
        return replace(cameras, viewmats=self.frame.leave_cameras(self.scene.cameras).viewmats[list(self.repeated)])


def with_photos(input_scene: Scene, canonical: PicturedScene, repeated: Sequence[int]) -> Scene:
    """Return the input scene with the pictures and masks of the canonical scene, which has each view once.

    ``repeated`` has the index in the canonical scene of each view of the input scene.
    """
    if canonical.images is input_scene.images and canonical.masks is input_scene.masks:
        return input_scene
    masks = None if canonical.masks is None else canonical.masks[list(repeated)]
    large = None if canonical.large_photos is None else input_scene.large_photos
    return replace(input_scene, images=canonical.images[list(repeated)], masks=masks, large_photos=large)
