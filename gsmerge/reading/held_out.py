"""Read held-out photos, which are compared with renders of a scene, and their cameras in the frame of the scene."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from gsmerge.errors import Doubt, SceneError, attempt
from gsmerge.frozen import dataclass, replace
from gsmerge.io.bounds import no_such_path
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, select_views, sizes_of, to_cameras, with_convention
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.io.cameras.table import IN_SPLAT_FRAME
from gsmerge.io.image_names import find_image
from gsmerge.io.photo_files import as_floats, photo_size, same_shape
from gsmerge.method.geometry.transforms import IDENTITY, Similarity, camera_centres, fit_similarity
from gsmerge.method.kernels.elementary import arccos
from gsmerge.reading.exporters import NO_HINTS
from gsmerge.reading.larger_photos import limit_photo_size
from gsmerge.reading.photos.scene_photos import read_stored_photos
from gsmerge.reading.read_scene import Loaded
from gsmerge.reading.scene_files import SceneFiles
from gsmerge.types import Scene, StrPath, Views

_NO_TARGETS = (
    "targets are photos with their cameras; without targets, the scene's own views or placed ones are measured"
)
_OPTION = "evaluate --target-images"  # `gsmerge view` does not have this option


@dataclass(frozen=True)
class HeldOutViews(Views):
    """Views from which a scene was not made, in the frame of its Gaussians; :class:`Views` with facts about their file.

    ``places`` are their indices in the camera file. ``context_places`` are the indices of the scene's own views in this
    file; None if it lacks one. ``notes`` say what was adapted.
    """

    places: tuple[int, ...]  # index of each held-out view in the camera file, which is its place along the trajectory
    context_places: tuple[int, ...] | None  # index in this file of each view of the scene; None if it lacks a view
    notes: tuple[str, ...] = ()  # notes on what was adapted, one sentence each


def read_held_out(load: Loaded, cameras: StrPath, images: StrPath | None = None) -> HeldOutViews:
    """Read held-out photos and their cameras, in any format that a scene may have.

    Views from which the scene was made are left out. If the file has views of the scene under the same names, their
    poses show how the file's world maps to the world of the Gaussians. If the poses of shared names show no such map,
    the file is assumed to be in the world of the scene's own cameras. Poses are read in the convention in which the
    scene's cameras fit.

    Args:
        load: The scene, from :func:`load_scene`.
        cameras: Camera file or folder of the held-out photos.
        images: Folder of the photos; None: the camera file names them.

    Returns:
        :class:`Views` of the scene's world, with ``places``: the index of each view in the camera file.

    Raises:
        SceneError: If a file is missing or damaged, or if no view remains.

    Example:
        >>> held_out = gsmerge.read_held_out(gsmerge.load_scene("demo"), "demo/targets")
        >>> len(held_out.cameras), held_out.images.shape
        (4, (4, 32, 48, 3))
    """
    path = Path(cameras)
    if not path.exists():
        raise no_such_path(path, "expected cameras of held-out views, found no such file or folder")
    read = attempt(read_into_frame, load, path)
    if isinstance(read, SceneError):
        raise SceneError(read.path, read.problem, read.remedy or _NO_TARGETS)
    camera_file, shared = read
    shared |= _match_by_pose(camera_file.viewmats, load.scene)
    places = [i for i in range(len(camera_file)) if i not in shared]
    if not places:
        problem = "expected held-out views, found only views that the scene was made from"
        raise SceneError(path, problem, "name a camera file that has other views of the scene")
    held_out = select_views(camera_file, places)
    if images is not None and not Path(images).is_dir():
        actual = "a file" if Path(images).exists() else "no such folder"
        raise SceneError(images, f"expected a folder of photos, found {actual}", f"name it with {_OPTION}")
    # the camera file may have photos inside; otherwise photos that are not named are searched
    inside = path if len(held_out.images) else None
    files = SceneFiles(load.files.ply, path, inside if images is None else Path(images), photo_option=_OPTION)
    photos = read_stored_photos(files, held_out)
    if not len(photos):
        root = path if path.is_dir() else path.parent
        missing = next((name for name in held_out.names if find_image(root, name, path) is None), held_out.names[0])
        raise SceneError(
            path, f"expected photos of its views, found none for {missing}", f"name their folder with {_OPTION}"
        )
    pinholes, photos, _ = as_pinholes(held_out, photos)
    photos, notes = limit_photo_size(photos, 0, NO_HINTS.max_side, unaligned=False)
    size = photo_size(photos) or (1, 1)
    for shape in sizes_of(pinholes):
        if not same_shape(shape, size):
            found = "the cameras of {} x {} are stretched to the held-out photos, {} x {}".format(*shape, *size)
            notes.append(Doubt(f"{found}; if these were cropped, name the whole photos, or cameras of crops"))
    place_of_view = {view: place for place, view in shared.items()}
    has_all = 0 < len(place_of_view) == len(load.scene)
    return HeldOutViews(
        cameras=to_cameras(pinholes, photo_size(photos)),
        images=as_floats(photos),
        names=held_out.names,
        places=tuple(places),
        context_places=tuple(place_of_view[view] for view in range(len(load.scene))) if has_all else None,
        notes=tuple(notes),
    )


def read_into_frame(load: Loaded, path: Path) -> tuple[CameraFile, dict[int, int]]:
    """Read a camera file, and move its cameras into the frame of a scene's Gaussians; also find the shared views.

    Shared views are views of the file that the scene also has. The second result maps their indices in the file to
    their indices in the scene. Frame and convention are found as in :func:`read_held_out`.
    """
    stored = read_cameras(path)
    if stored.source in IN_SPLAT_FRAME:
        return stored, {}
    own_cameras = load.cameras
    conventions = [stored]  # the cameras of the file, read in each convention
    if own_cameras is not None and own_cameras.source == stored.source and own_cameras.convention != stored.convention:
        conventions.insert(0, with_convention(stored, own_cameras.convention))
    worlds = [(camera_file, *_find_world(camera_file, load)) for camera_file in conventions]
    with_shared_views = (entry for entry in worlds if entry[2])
    camera_file, world, shared = next(with_shared_views, worlds[0])
    return replace(camera_file, viewmats=world.move_viewmats(camera_file.viewmats)), shared


def _find_world(camera_file: CameraFile, load: Loaded) -> tuple[Similarity, dict[int, int]]:
    """Find the similarity from the file's world to the world of the Gaussians, and the views that the scene also has.

    The second result maps views of the file to views of the scene with the same name, by index; folders and endings of
    names are ignored. The map is empty if names are not unique, or if no similarity brings the two poses of all shared
    views together.
    """
    stored = _find_similarity(load)
    names = load.scene.names
    file_views, scene_views = (
        {PurePosixPath(name.replace("\\", "/")).stem: i for i, name in enumerate(view_names)}
        for view_names in (camera_file.names, names)
    )
    shared = {file_views[stem]: view for stem, view in scene_views.items() if stem in file_views}
    if not shared or len(file_views) < len(camera_file) or len(scene_views) < len(names):
        return stored, {}
    theirs = camera_file.viewmats[list(shared)]
    ours = load.scene.cameras.viewmats[list(shared.values())]
    min_shared = 3  # fewest views that determine the similarity between two worlds
    frames = [stored, fit_similarity(theirs, ours, stored.scale)] if len(shared) >= min_shared else [stored]
    max_angle = 0.2  # degrees by which a view's two poses may differ in one frame
    max_shift = 0.005  # largest distance between a view's two poses, relative to the extent of all views
    for frame in frames:
        moved = frame.move_viewmats(theirs)
        centres = camera_centres(ours)
        cosines = ((moved[:, :3, :3] * ours[:, :3, :3]).sum((1, 2)) - 1) / 2
        distance = np.linalg.norm(camera_centres(moved) - centres, axis=1).max()
        spread = float(np.linalg.norm(np.ptp(centres, axis=0), axis=0)) or 1.0
        angle = np.degrees(arccos(cosines.clip(-1, 1))).max()
        if angle <= max_angle and distance / spread <= max_shift:
            return frame, shared
    return stored, {}


def _find_similarity(load: Loaded) -> Similarity:
    """Find the similarity from the world of a scene's own camera file to the world of its Gaussians.

    A camera file of held-out photos is assumed to be in the world of the scene's camera file. The result is the
    identity if the scene has no camera file, or if the poses in this file cannot be compared with the poses of the
    scene.
    """
    if load.recovery is not None:
        return load.recovery.frame
    if load.cameras is None or load.files.cameras is None:
        return IDENTITY
    camera_file = read_cameras(load.files.cameras, folder=load.files.ply.parent)
    if (camera_file.names, camera_file.convention) != (load.cameras.names, load.cameras.convention):
        return IDENTITY  # other views, or another convention: the poses cannot be compared
    if np.array_equal(camera_file.viewmats, load.cameras.viewmats):
        return IDENTITY  # a fit would differ from it by rounding
    return fit_similarity(camera_file.viewmats, load.cameras.viewmats)


def _match_by_pose(viewmats: np.ndarray, scene: Scene) -> dict[int, int]:
    """Map views with ``viewmats [t,4,4]`` in the scene's frame to views of the scene with the same pose, by index."""
    if len(scene) == 0 or len(scene.gaussians) == 0:
        return {}
    ours = scene.cameras.viewmats
    middle = np.median(scene.gaussians.means, 0)
    # Equal poses differ by at most this in the elements of rotations, and in the centres as a share of the distance
    # from the scene. Shifts are not compared with distances between views, because there may be a single view
    same_pose = 1e-4
    limit = same_pose * float(np.linalg.norm(camera_centres(ours) - middle, axis=1).max())
    same_place = np.linalg.norm(camera_centres(viewmats)[:, None] - camera_centres(ours), axis=2) <= limit
    same_rotation = np.abs(viewmats[:, None, :3, :3] - ours[None, :, :3, :3]).max((2, 3)) <= same_pose
    return {int(i): int(view) for i, view in zip(*np.nonzero(same_place & same_rotation), strict=True)}
