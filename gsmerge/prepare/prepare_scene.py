"""Scene -> prepared scene: the scene in its canonical frame, and facts about it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from gsmerge.frozen import dataclass, field, replace
from gsmerge.geometry.frame import Frame, canonicalise, sample_rows
from gsmerge.geometry.views import camera_kinds, subset
from gsmerge.prepare.compare_photos import compare_photos
from gsmerge.prepare.confirm_depths import Agreement, confirm_depths
from gsmerge.prepare.draw_left_out import draw_left_out, mask_background
from gsmerge.prepare.draw_outside import draw_outside
from gsmerge.prepare.exposure import equalise_exposure
from gsmerge.prepare.fill_holes import fill_holes
from gsmerge.prepare.move_poses import move_poses
from gsmerge.prepare.place_cameras import (
    HELD_OUT,
    NO_VIEWS,
    VIEWER_VIEWS,
    add_views,
    draw_around,
    draw_pictures,
    place_inside,
)
from gsmerge.prepare.row_colors import NO_PHOTOS, PHOTOS, RENDERS, ROW_COLORS, add_row_colors
from gsmerge.prepare.scene_size import SceneSize, measure_size, unlike_captures
from gsmerge.prepare.true_pixels import raise_sizes, with_pixels
from gsmerge.raster.photos import counting_pixels
from gsmerge.runtime.record import note, record_choices, record_part, stage
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import Cameras, PicturedScene, Scene

LEAST_VIEWS = 4  # fewest views with photos of which some are left out; of fewer views, too little would remain
FLAT = 2 / 255  # a picture shows one flat colour if the range of its values is smaller


@dataclass(frozen=True, eq=False)
class Reference:
    """Which pictures of a canonical scene a result is fitted to and scored on."""

    name: str  # "photos", or the name of the pictures that replace them
    score_views: tuple[int, ...]  # Views whose pictures results are scored on
    # True if the scene has no views, so that all views are placed; no fit sees the views for scores
    placed: bool = False
    # [v,h,w,3] unchanged photos of the input scene, if the run changed some of them
    photo_files: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def of_views(self) -> bool:
        """Return whether the pictures are photos or the colours of the views' own Gaussians, and not renders."""
        return self.name != RENDERS


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in its canonical frame, as the stages use it, with facts about it."""

    input_scene: Scene  # The scene as it was read, in its own world frame, with photos that look like its Gaussians
    # The canonical scene with pixels. It has every view once, and photos that do not show it are replaced
    scene: PicturedScene
    frame: Frame  # The canonical frame
    reference: Reference  # Use of the pictures
    repeated: tuple[int, ...]  # Index in the canonical scene of every view of the input scene
    moved: bool  # True if views were moved to poses at which their photos agree, before a fit or by it
    agreement: Agreement | None = None  # Shares of depth that views confirm; None if views cannot be compared

    @property
    def size(self) -> SceneSize:
        """Sizes of the scene that the plan depends on."""
        own_views = self.input_scene if self.reference.placed else self.scene  # placed views do not count
        size = measure_size(own_views, rendered=not self.reference.of_views)
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
        return _with_photos(self.input_scene, self.scene, self.repeated)

    def final_cameras(self) -> Cameras:
        """Return the input views' cameras in the world, with the poses that the fit has moved."""
        cameras = self.input_scene.cameras
        if not self.moved:
            return cameras
        return replace(cameras, viewmats=self.frame.leave_cameras(self.scene.cameras).viewmats[list(self.repeated)])


@stage("prepare")
def prepare(
    scene: Scene,
    options: PrepareOptions | None = None,
    frame: Frame | None = None,
    *,
    fill: bool = True,
    outside: bool = True,
    pixels: bool = True,
) -> Prepared:
    """Bring a scene to what the stages need; notes name missing data and what replaces it.

    Repeated views are dropped, and views are placed if there are none. Rows and photos are compared: photos that show
    the scene get its tones and its exposure, and views move to where they agree. Then holes are filled, and what no
    view sees is drawn.

    ``frame`` is the canonical frame; None stands for the scene's own frame. With ``fill``, Gaussians are added at
    pixels that only pictures show. With ``outside``, pictures of Gaussians that no view sees are drawn; it is False if
    other views of a larger scene see these Gaussians. With ``pixels``, the pixels of placed views are found, which
    superpixels need. Raises ValueError if there is no finite Gaussian, or if there are images without cameras.
    """
    options = options or PrepareOptions()
    input_scene, placed = replace(scene, depths=None), len(scene) == 0  # depth maps serve for holes alone
    scene, repeated, notes = without_repeats(scene)
    for text in notes:
        note(text)
    scene, frame = canonicalise(add_views(scene), frame)
    scene = raise_sizes(with_pixels(scene) if pixels or not placed else scene, placed=placed)
    scene, reference = choose_pictures(scene, options, placed=placed)
    is_moved, files = False, input_scene.images
    if reference.of_views:
        input_scene = _with_photos(input_scene, scene, repeated)
    if scene.has_own_pixels:  # each view's Gaussians have the exposure and the pose of the view
        scene = equalise_exposure(scene, reference.score_views, options.exposure)
        if options.poses != "fixed":
            moved = move_poses(scene, reference.score_views, always=options.poses == "free")
            is_moved, scene = moved is not None, moved or scene
    if reference.name == PHOTOS and files is not None and _has_changed(files, scene, reference.score_views, repeated):
        reference = replace(reference, photo_files=files)
    agreement = confirm_depths(scene)
    if agreement is not None:
        record_choices(agreement=agreement.to_dict())
        if agreement.advice:
            note(agreement.advice)
    if fill and reference.of_views:
        views, shown, masks = reference.score_views, np.zeros(scene.images.shape[:3], bool), scene.masks
        has_row_colors = reference.name == ROW_COLORS  # these pictures have colours at all pixels
        shown[list(views)] = True if has_row_colors or masks is None else masks[list(views)]
        scene = fill_holes(scene, shown, everywhere=options.extent == "photos")
        scene = draw_left_out(replace(scene, depths=None), masks)
        if scene.empty is not None and scene.masks is not None:  # views that count nowhere any more are not scored
            seen = tuple(view for view in views if scene.masks[view].any())
            reference = replace(reference, score_views=seen or views)
    if outside and not scene.has_own_pixels and not placed:
        drawn = draw_outside(scene)
        if reference.name == RENDERS and drawn is not scene:  # all pixels of all pictures are drawings
            views = (*reference.score_views, *range(len(scene), len(drawn)))
            drawn, reference = replace(drawn, masks=None), replace(reference, score_views=views)
        scene = drawn
    return Prepared(input_scene, scene, frame, reference, tuple(repeated), is_moved, agreement)


def choose_pictures(scene: Scene, options: PrepareOptions, *, placed: bool) -> tuple[PicturedScene, Reference]:
    """Return a canonical scene with the pictures to which results are fitted, and how they are used.

    Photos that show the scene are used first. If no photo shows the scene, a view's picture has the colours of its
    Gaussians, or if views share Gaussians, it is a render. ``placed`` is true if the scene had no views.
    """
    has_photos, every = scene.images is not None, tuple(range(len(scene)))
    if scene.images is not None:
        pictured = PicturedScene.with_pictures(scene, scene.images, scene.masks)
        if options.extent != "photos" and options.look != "scene":
            pictured = mask_background(pictured)  # before photos are compared, which show nothing of the scene there
        pictured, views = compare_photos(pictured, options.look)
        if views:
            return pictured, Reference(PHOTOS, views)
    scene = replace(scene, images=None, large_photos=None, masks=None)
    if scene.has_own_pixels:
        return add_row_colors(scene, has_photos=has_photos), Reference(ROW_COLORS, every)
    reason = "photos do not count" if has_photos else "no photos, and the rows are not the pixels of the views"
    remedy = "" if has_photos else "; name photos with --images"
    if not placed:  # if views were placed, another note has said this
        note(f"{reason}: renders of the scene itself are used instead{remedy}")
    drawn, scored = draw_pictures(scene), every[: len(every) // HELD_OUT] if placed else every
    shown = tuple(view for view in scored if drawn.images[view].any())  # any result is right in an empty view
    return drawn, Reference(RENDERS, shown or scored, placed)


def _has_changed(photos: np.ndarray, scene: PicturedScene, views: Sequence[int], repeated: Sequence[int]) -> bool:
    """Return whether preparation changed a pixel of the input's ``photos`` that counts in scores of ``views``.

    ``repeated`` has the index in the ``scene`` of each photo's view.
    """
    if scene.images is photos:
        return False
    counting = counting_pixels(scene)
    return any(
        not np.array_equal(before[counting[view]], scene.images[view][counting[view]])
        for before, view in zip(photos, repeated, strict=True)
        if view in views
    )


def without_repeats(scene: Scene) -> tuple[Scene, list[int], list[str]]:
    """Return a scene without repeated views, every input view's index in this scene, and notes on repeated views."""
    views, repeated = distinct_views(scene)
    count = len(scene) - len(views)
    if not count:
        return scene, repeated, []
    one = "1 view repeats another in every pixel and counts once"
    notes = [one if count == 1 else f"{count} views repeat others in every pixel and count once"]
    return subset(scene, views), repeated, notes


def distinct_views(scene: Scene) -> tuple[list[int], list[int]]:
    """Return the ids of the views that repeat no earlier view, and the index of every view in the list of these ids.

    Two views are equal if their cameras, photos, masks and Gaussians are equal.
    """
    kinds = camera_kinds(scene.cameras)
    distinct, indices = list[int](), list[int]()
    for view, kind in enumerate(kinds):
        equal = (
            i for i, earlier in enumerate(distinct) if kinds[earlier] == kind and _equal_views(scene, earlier, view)
        )
        indices.append(next(equal, len(distinct)))
        if indices[-1] == len(distinct):
            distinct.append(view)
    return distinct, indices


def _equal_views(scene: Scene, first: int, second: int) -> bool:
    """Return whether two views of one camera have the same photo, mask, importance and Gaussians."""
    for pictures in (scene.images, scene.masks, scene.importance):
        if pictures is not None and not np.array_equal(pictures[first], pictures[second]):
            return False
    if not scene.has_own_pixels:
        return True
    a, b = (scene.get_pixels().rows_of_views[view] for view in (first, second))
    return all(np.array_equal(values[a], values[b]) for values in vars(scene.gaussians).values())


def views_notes(scene: Scene) -> list[str]:
    """Return the notes of a run about repeated views and about missing views or photos; no colours are compared."""
    if len(scene) == 0:
        return [NO_VIEWS if place_inside(scene.gaussians) is None else VIEWER_VIEWS]
    return [*without_repeats(scene)[2], *([NO_PHOTOS] if scene.images is None and scene.is_shown else [])]


def scored_pictures(scene: Scene) -> tuple[Scene, bool]:
    """Return a scene with its pictures for scores, and whether :func:`prepare` would change these pictures.

    The pictures are the photos. If photos are missing, have another look, or do not show the scene, and each Gaussian
    belongs to one view, a view's picture has the colours of its Gaussians.
    """
    has_pictures = scene.has_own_pixels or scene.images is not None
    if len(scene) == 0 or len(scene.gaussians) == 0 or not has_pictures:
        return scene, False
    with record_part(silent=True):
        canonical = canonicalise(scene)[0]
        if scene.images is not None:
            given = mask_background(with_pixels(PicturedScene.with_pictures(canonical, scene.images, scene.masks)))
            compared, views = compare_photos(given)
            if views or not scene.has_own_pixels:
                if canonical.has_own_pixels:
                    compared = equalise_exposure(compared, views, "auto")
                left_out = len(views) < len(given.photo_views)
                if given.masks is not canonical.masks:
                    scene = replace(scene, masks=given.masks)
                return scene, left_out or _has_changed(given.images, compared, views, range(len(given)))
        colored = add_row_colors(replace(canonical, images=None, large_photos=None, masks=None))
    return replace(scene, images=colored.images, masks=colored.masks), False


def _with_photos(input_scene: Scene, canonical: PicturedScene, repeated: Sequence[int]) -> Scene:
    """Return the input scene with the pictures and masks of the canonical scene, which has each view once.

    ``repeated`` has the index in the canonical scene of each view of the input scene.
    """
    if canonical.images is input_scene.images and canonical.masks is input_scene.masks:
        return input_scene
    masks = None if canonical.masks is None else canonical.masks[list(repeated)]
    large = None if canonical.large_photos is None else input_scene.large_photos
    return replace(input_scene, images=canonical.images[list(repeated)], masks=masks, large_photos=large)
