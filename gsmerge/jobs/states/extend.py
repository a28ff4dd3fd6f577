"""State and new views -> state: compact a batch of views, and add its Gaussians, cameras and pictures to a state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gsmerge.errors import SceneError, split_notes
from gsmerge.frozen import asdict, dataclass, replace
from gsmerge.io.photo_files import photo_array
from gsmerge.method.facts.agreement import CHANCE_ERRORS, NORMAL_SAMPLES
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.geometry.transforms import camera_centres, camera_distances
from gsmerge.method.geometry.views import camera_kinds, concat_cameras, in_float64, resize_cameras, subset
from gsmerge.method.raster.photos import counting_pixels, shrink_pictures
from gsmerge.reading.alignment import check_cameras
from gsmerge.results.outputs import join_gaussians
from gsmerge.run import compact_prepared, plan_run
from gsmerge.runtime.record import Progress, record_run
from gsmerge.runtime.threads import use_threads
from gsmerge.scoring.sizes import resize_mask
from gsmerge.settings.compact import ONE_PIECE, CompactOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.types import Cameras, Gaussians, Scene

# A "world" is a frame of coordinates. The colours of the earlier Gaussians in front are compared with the new pictures
# of them. The difference of these colours is divided by the difference from random pixels. The quotient of both
# differences was measured in batches of 15 captures: at most .87 in the same world, and .92 to 1.08 in another world.
# So the worlds differ if the quotient is above WORLD_RATIO. If the quotient is so near WORLD_RATIO that chance may
# decide, the comparison has no result.
WORLD_RATIO = 0.9
# results of comparing two worlds
SAME_WORLD = "the same"
ANOTHER_WORLD = "another"
UNKNOWN_WORLD = "not known"
BATCH = "batch"  # path in an error about a batch, until the caller puts in the path of its file
NOT_COMPARED = (
    "the pictures of this batch show too little of the earlier Gaussians to say whether both are in the same world"
)


@dataclass(frozen=True)
class BatchReport:
    """Report of one batch."""

    num_views: int
    num_input: int  # Gaussians of the batch
    num_new: int  # Gaussians that the batch became; superpixels in a state of Feature Gaussians
    num_gaussians: int  # Gaussians, or Feature Gaussians, of the state afterwards
    num_kept: int  # views whose pictures the state keeps afterwards
    pictures: str  # pictures to which the batch is fitted: "photos", or the name of what stands in for photos
    views: Mapping[str, str]  # names in the batch, by names in the state, of its views whose pictures the state keeps
    sh_degree: int  # of the batch's Gaussians
    seconds: Mapping[str, float]  # wall time of each stage
    choices: Mapping[str, Any]  # decisions of the stages; `world` compares the world of the batch with earlier batches
    notes: tuple[str, ...]  # warnings, one sentence each
    options: Mapping[str, Any]  # all settings, by their names in reports

    @property
    def numbers(self) -> dict[str, Any]:
        """Facts of this report, by name, that are stored in a state."""
        omitted = ("seconds", "choices", "notes", "options")
        return {name: value for name, value in asdict(self).items() if name not in omitted}


def extend(
    before: Scene | None,
    scene: Scene,
    options: CompactOptions,
    extend_options: ExtendOptions,
    *,
    progress: Progress | None = None,
) -> tuple[Scene, BatchReport]:
    """Compact a batch of views, and add it to the results of earlier batches, which have to be in the same world.

    ``before`` has the earlier results, and is None for the first batch. Camera poses and exposures of the new batch do
    not change. Returns a scene with the Gaussians of all batches, and the report. Rows of the scene do not belong to
    pixels. The scene keeps views at the size of the first batch's views, each with the picture to which its batch was
    fitted. Raises ValueError if a setting is impossible for the scene, and SceneError if the scene seems to be in
    another world.
    """
    options = options.with_settings(ONE_PIECE)
    with use_threads(options.threads), record_run(progress):
        prepared, plan = plan_run(scene, options)
        batch_views = _keep_pictures(prepared)
        world = UNKNOWN_WORLD
        parts = []
        if before is not None:
            world = compare_worlds(before.gaussians, batch_views, prepared.input_scene.gaussians.means)
            refuse_other_world(world, extend_options)
            parts = [before.gaussians]
        result = compact_prepared(prepared, plan)
    notes = split_notes(result.report.notes, "worse")[1]  # only of a final result is it said that it is worse
    notes += [NOT_COMPARED] if before is not None and world == UNKNOWN_WORLD else []
    gaussians = join_gaussians([*parts, result.gaussians.numpy()])
    views = batch_views if before is None else _join_views(before, batch_views)
    new_names = views.names[len(views) - len(batch_views.names) :]  # names of the batch's views in the state
    kept_views = subset(views, choose_distant_views(views.cameras, extend_options.max_views))
    joined = replace(kept_views, gaussians=gaussians)
    report = BatchReport(
        num_views=len(scene),
        num_input=scene.num_gaussians,
        num_new=len(result.gaussians),
        num_gaussians=len(gaussians),
        num_kept=len(joined),
        pictures=prepared.reference.name,
        views={new: name for new, name in zip(new_names, batch_views.names, strict=True) if new in joined.names},
        sh_degree=result.gaussians.sh_degree,
        seconds=result.report.seconds,
        choices=result.report.choices | {"world": world},
        notes=tuple(notes),
        options=options.to_dict() | asdict(extend_options),
    )
    return joined, report


def compare_worlds(before: Gaussians, views: Scene, means: np.ndarray) -> str:
    """Compare the world of new views with the world of the Gaussians ``before``.

    Returns SAME_WORLD, ANOTHER_WORLD or UNKNOWN_WORLD. In the same world the pictures show the earlier Gaussians,
    except where Gaussians of the batch, whose means are ``means [n,3]``, hide earlier ones. In another world the
    pictures differ from the earlier Gaussians as much as random pixels do.
    """
    if not len(views):
        return UNKNOWN_WORLD
    is_finite = np.isfinite(np.asarray(before.means)).all(1)
    hiding = means[np.isfinite(means).all(1)]
    pictures = photo_array(views.images)
    sample_gaussians = 10_000  # earlier Gaussians that are compared with new views
    check = check_cameras(before, is_finite, views.cameras, pictures, sample_gaussians, foremost=True, hiding=hiding)
    margin = CHANCE_ERRORS * check.ratio_error
    if check.num_compared < NORMAL_SAMPLES or not abs(check.color_ratio - WORLD_RATIO) > margin:
        return UNKNOWN_WORLD
    return SAME_WORLD if check.color_ratio < WORLD_RATIO else ANOTHER_WORLD


def refuse_other_world(world: str, options: ExtendOptions) -> None:
    """Raise SceneError for a batch that seems to be in another world, unless the options allow it."""
    if world == ANOTHER_WORLD and not options.other_world:
        problem = "expected views in the same world as earlier batches, found pictures that do not show their Gaussians"
        raise SceneError(BATCH, problem, "begin another .gsm with this batch, or add it with --set other_world=true")


def _keep_pictures(prepared: Prepared) -> Scene:
    """Return a scene without Gaussians, which has each view of the input once, with the picture for its fit."""
    input_scene = prepared.input_scene
    no_gaussians = prepared.input_scene.gaussians[:0]
    if prepared.reference.placed:  # the input has no views
        return Scene(no_gaussians, input_scene.cameras, None, None, input_scene.names)
    # A view may have several layers of Gaussians, each with the same camera, and only the first layer is kept
    first_layers = np.unique(camera_kinds(input_scene.cameras), return_index=True)[1]
    views = sorted(first_layers.tolist())
    kept = [prepared.repeated[view] for view in views]
    images = prepared.scene.images[kept]
    masks = prepared.scene.masks
    masks = None if masks is None else masks[kept]
    cameras = in_float64(input_scene.cameras[views])
    return Scene(no_gaussians, cameras, images, None, tuple(input_scene.names[view] for view in views), masks=masks)


def _join_views(before: Scene, batch: Scene) -> Scene:
    """Append the views of a batch to the views ``before``, in their size.

    :func:`append_names` gives the names of the views.
    """
    if len(batch) == 0 or len(before) == 0:
        return before if len(batch) == 0 else batch
    size = before.cameras.width, before.cameras.height
    assert before.images is not None
    assert batch.images is not None
    images = batch.images
    cameras = batch.cameras
    counts = counting_pixels(batch)
    if images.shape[2:0:-1] != size:
        images = shrink_pictures(images, *size)
        cameras = resize_cameras(cameras, *size)
        counts = np.stack([resize_mask(mask, *size) for mask in counts])
    all_counts = np.concatenate([counting_pixels(before), counts])
    return replace(
        before,
        cameras=concat_cameras(before.cameras, cameras),
        images=np.concatenate([before.images, images]),
        masks=None if all_counts.all() else all_counts,
        names=append_names(before.names, batch.names),
    )


def append_names(before: tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """Append ``names`` of views to the names ``before``, and return all. A name in use gets a number in front."""
    all_names = list(before)
    for name in names:
        numbered = (f"{number}-{name}" for number in range(2, len(all_names) + 3))
        all_names.append(name if name not in all_names else next(new for new in numbered if new not in all_names))
    return tuple(all_names)


def choose_distant_views(cameras: Cameras, count: int) -> list[int]:
    """Choose at most ``count`` views that are far apart, in rising order.

    The first view is chosen first. Each next view is the farthest from all chosen views. The distance of two views is
    the distance of their centres, as a share of the widest extent of all centres, plus the distance of their
    directions.
    """
    if len(cameras) <= count:
        return list(range(len(cameras)))
    centres = camera_centres(cameras.viewmats.astype(np.float64))
    extent = float(np.ptp(centres, axis=0).max()) or 1.0
    viewmats = cameras.viewmats.astype(np.float64).copy()
    viewmats[:, :3, 3] /= extent
    distances = camera_distances(replace(cameras, viewmats=viewmats))
    chosen = [0][:count]
    while len(chosen) < count:
        chosen_distances = distances[chosen].min(0)  # of each view, from the nearest chosen view
        chosen_distances[chosen] = -1
        chosen.append(int(np.argmax(chosen_distances)))
    return sorted(chosen)
