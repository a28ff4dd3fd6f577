"""List the cameras that may belong to the Gaussians of a scene, and read them with the list of their photos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gsmerge.errors import SceneError, attempt
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile, drop_repeats, missing_intrinsics
from gsmerge.io.cameras.read_cameras import read_cameras, read_sharp_camera
from gsmerge.io.formats.read_gaussians import GaussianFile
from gsmerge.reading.alignment import estimate_cameras
from gsmerge.reading.photos.scene_photos import NO_PHOTOS, ScenePhotos, find_photos
from gsmerge.reading.scene_files import SceneFiles

WITHOUT_LENS = "without their lens"  # photos may be undistorted already, although a file has the lens that took them

# Ways of reading cameras otherwise than their file says, by the words that a user reads in the table of candidates.
# Each function returns the cameras in its way, or None if the file gives no reason to try it. See "A way of reading
# cameras" in docs/internals/adding.md
WAYS: dict[str, Callable[[CameraFile], CameraFile | None]] = {
    WITHOUT_LENS: lambda camera_file: replace(camera_file, lenses=()) if camera_file.lenses else None
}
SHOWN_BY_PHOTOS = frozenset({WITHOUT_LENS})  # ways that are tried only if photos fit better so


@dataclass(frozen=True, eq=False)
class Candidate:
    """Cameras that may belong to a scene: those of a file, read as it says or in another way, or those of the rows."""

    files: SceneFiles  # with these cameras
    way: str = ""  # key of ``WAYS``; empty: as the file says
    # True: in place of the camera files, which are left out, cameras are estimated from the rows
    replaces_files: bool = False


@dataclass(frozen=True, eq=False)
class Views:
    """The cameras of a candidate as they were read, and the photos that may show their views."""

    candidate: Candidate
    camera_file: CameraFile | None = None  # the cameras as stored, or as estimated from the rows; None: there are none
    photos: ScenePhotos = NO_PHOTOS
    is_searched: bool = True  # False: no photos are wanted
    error: SceneError | None = None  # why the cameras cannot be read, or not without photos that cannot be listed
    photo_error: SceneError | None = None  # why photos cannot be listed without which the cameras may be used

    @property
    def files(self) -> SceneFiles:
        """The scene's files with these cameras."""
        return self.candidate.files

    @property
    def place(self) -> Path | None:
        """Folder or file of the photos; None without any."""
        return self.photos.folder if self.photos.named else self.files.images


def list_candidates(files: SceneFiles, *, keeps_cameras: bool = False) -> list[Candidate]:
    """List what may be the cameras of a scene, in the order in which they are tried.

    - The camera files as they are. If no camera file lies beside the scene, the first candidate has none; its cameras
      may be inside the ``.ply``, or are estimated from the rows. Cameras in sub-folders are listed only if one
      sub-folder has them all, since several sub-folders may be several scenes.
    - The same files in each of the ``WAYS``.
    - Cameras that are estimated from the rows in place of all files, unless ``keeps_cameras``.
    """
    # images inside the camera file belong only to its cameras
    without_cameras = replace(files, cameras=None, images=None if files.images == files.cameras else files.images)
    others = () if files.is_spread else files.others
    stored = [files, *(replace(without_cameras, cameras=path, above=()) for path in others)]
    candidates = [Candidate(one, way) for way in ("", *WAYS) for one in stored if not way or one.cameras is not None]
    if files.cameras not in (None, files.ply) and not keeps_cameras:
        candidates.append(Candidate(without_cameras, replaces_files=True))
    return candidates


def parse_views(ply: GaussianFile, candidate: Candidate, *, photos: bool) -> Views | None:
    """Read a candidate's cameras, and list the photos that may show their views; none if ``photos`` is False.

    The cameras cannot be used without photos that the caller named or that the camera file holds. Returns None if the
    file gives no reason to read it in the candidate's way.
    """
    files = candidate.files
    camera_file = attempt(read_scene_cameras, ply, files)
    if isinstance(camera_file, SceneError):
        return None if candidate.way else Views(candidate, error=camera_file)
    if camera_file is not None and candidate.way:
        camera_file = WAYS[candidate.way](camera_file)
        if camera_file is None:
            return None
    if camera_file is None or not photos:
        return Views(candidate, camera_file, is_searched=photos)
    found = attempt(find_photos, files, camera_file)
    if not isinstance(found, SceneError):
        return Views(candidate, camera_file, found)
    if "images" in files.named or files.images == files.cameras:
        return Views(candidate, camera_file, error=found)
    return Views(candidate, camera_file, photo_error=found)


def read_scene_cameras(ply: GaussianFile, files: SceneFiles) -> CameraFile | None:
    """Read a scene's cameras from their file or the ``.ply``, or estimate them from the rows; None if that fails.

    Repeated views are dropped, unless the number of rows is a multiple of the number of views. Raises SceneError if a
    file has poses, but no focal length.
    """
    if files.cameras is not None:
        stored = read_cameras(files.cameras, folder=files.ply.parent)
        if not stored.has_intrinsics:
            raise missing_intrinsics(stored.path)
        # each repeated view may have rows, too, if the number of rows is a multiple of the number of views
        return drop_repeats(stored) if len(ply.gaussians) % len(stored) else stored
    if files.is_state:  # cameras of a state are in its own file, or there are none
        return None
    sharp = None if "cameras" in files.named else read_sharp_camera(files.ply)
    if sharp is not None:
        return sharp
    return estimate_cameras(files.ply, ply.gaussians.means, ply.valid)
