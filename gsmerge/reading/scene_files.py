"""Find the files of a scene: its ``.ply``, cameras, photos and masks."""

from __future__ import annotations

import filecmp
import os
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice, pairwise
from pathlib import Path

from gsmerge.errors import SceneError, attempt
from gsmerge.frozen import dataclass, replace
from gsmerge.io.bounds import check_file, no_such_path
from gsmerge.io.cameras.foreign import check_program, find_unread
from gsmerge.io.cameras.read_cameras import (
    count_images,
    find_cameras,
    find_other_cameras,
    holds_images,
    list_cameras,
    read_cameras,
    read_sharp_camera,
)
from gsmerge.io.cameras.table import is_colmap
from gsmerge.io.cameras.viewer_cameras import viewer_cameras_path
from gsmerge.io.formats.ply import header_content, header_counts, is_from_gsmerge, read_header
from gsmerge.io.formats.table import (
    META,
    OUTPUT_FORMATS,
    SCENE_SUFFIXES,
    SEVERAL_USES,
    STATE_ENDING,
    find_format,
    may_hold_gaussians,
)
from gsmerge.io.image_names import IMAGE_PLACES, check_photo_folder, is_drawn, list_images, match_masks, natural_order
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.runtime.record import list_some
from gsmerge.settings.reading import NONE
from gsmerge.types import StrPath

_check_scene_file = LazyFunction("gsmerge.io.no_gaussians", "check_scene_file")
_no_gaussians = LazyFunction("gsmerge.io.no_gaussians", "no_gaussians")
_holds_views = LazyFunction("gsmerge.io.formats.gsm", "holds_views")
# Paths in a folder at which a scene's .ply may lie. The first path with a scene is read, or else the folder's only .ply
PLY_PLACES = ("scene.ply", "gaussians.ply", "gs_ply/0000.ply", "point_cloud.ply")
# Places where INRIA and gsplat write trained scenes. Of several trained scenes, the scene with the most steps of
# training is read
TRAINED_PLACES = ("point_cloud/iteration_*/point_cloud.ply", "iteration_*/point_cloud.ply", "ply/point_cloud_*.ply")
SCENES_PLACE = "gaussians"  # folder where DepthSplat and its relatives write NAME.ply; the photos are in images/NAME
KINDS = {"images": "photos"}  # option -> kind of the files that it names, if users call the kind otherwise
MASK_PLACES = ("masks", "keyframes/masks")
_OTHER_PICTURES = {"masks", "targets"}  # folders of pictures that are no photos of the scene's views
_POINT_CLOUDS = {"input.ply", "points3D.ply", "points.ply", "sparse_pc.ply"}  # names of point clouds of other programs
_NUMBERED = re.compile(r"(.*?)[-_. ]?(\d+)\.ply")
_STEPS = re.compile(r"(?:iteration|point_cloud)_(\d+)(?:\.ply|[\\/]point_cloud\.ply)$")
# Words before the number in a file's name, which say that the file holds one view or one part of a scene
_PARTS = {"view", "chunk", "part", "block", "tile"}
_EXPORT = re.compile(r"(.*?)[-_. ]?(\d+)(k?\.[a-z.]+)", re.IGNORECASE)  # 30k stands for 30,000
# Words before the number in names of steps of a training, and in names of files that are no steps
_STEP_WORDS = "export", "splat", "splats", "step", "iter", "iteration", "ckpt", "checkpoint", "cloud", "model"
_OTHER_WORDS = "", "frame", "image", "img", "camera", "cam", "scene", "time", "moment", *_PARTS
# Ends of paths that a program gives to all its scenes, so that these ends do not name a scene
_USUAL_END = re.compile(
    r"/(?:(?:exports/)?gs_ply/\d+|(?:point_cloud/iteration_\d+/)?point_cloud|ply/point_cloud_\d+|scene|gaussians)$"
)
_LEVEL = re.compile(r"\.level\d+(?=\.)")  # in the name of a level of detail, see :func:`level_output`
_RESULT = re.compile(r"\.compact(\.level\d+)?(\.compressed)?\.ply$")
_PACKED = {*SCENE_SUFFIXES} - {".ply"}
_MAX_HEADERS = 1_000  # most headers of a folder's files that are read; further files count as scenes
_MAX_ENTRIES = 10_000  # most files and folders that a search below a folder lists


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene.

    ``cameras`` may be a COLMAP folder, or the ``.ply`` itself if the cameras are in it. ``images`` may be an ``.npz``
    with images in it. A ``.gsm`` may hold Gaussians, cameras and images at once.
    """

    ply: Path
    cameras: Path | None
    images: Path | None
    masks: Path | None = None  # a folder
    protect: Path | None = None  # a folder of images of what has to stay sharp; only the caller can name it
    more: tuple[SceneFiles, ...] = ()  # other scenes that show the same place, each in a frame of its own
    parts: tuple[Path, ...] = ()  # all files of a scene in several files, ``ply`` first; empty for a single file
    num_copies: int = 0  # number of other files in the folder with the same bytes as ``ply``
    num_steps: int = 0  # number of earlier steps of the same training beside ``ply``
    named: frozenset[str] = frozenset()  # names of the fields that the caller set, so that they are not searched
    photo_option: str = "--images"  # option with which the user names the folder of ``images``
    # Photos, cameras and masks in the folder above the scene, if the scene lacks them: the option and the path of each.
    # A note names these paths, but gsmerge never reads them
    above: tuple[tuple[str, Path], ...] = ()
    others: tuple[Path, ...] = ()  # further camera files, tried in turn if ``cameras`` do not fit
    below: bool = False  # True: ``others`` are in folders below, and are read only if photos show that they fit
    root: Path | None = None  # the scene's own folder
    folder: Path | None = None  # the folder that the user named; None: a file

    @property
    def plys(self) -> tuple[Path, ...]:
        """Paths of the scene's files of Gaussians, in the order in which they are read."""
        return self.parts or (self.ply,)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Paths of all files and folders from which the scene is read: Gaussians, cameras and pictures."""
        beside = (self.cameras, self.images, self.masks, self.protect, *self.others)
        return (*self.plys, *(path for path in beside if path is not None))

    @property
    def is_spread(self) -> bool:
        """Return whether cameras lie in several folders below the scene, which may be several scenes."""
        return self.below and len({Path(os.path.relpath(path, self.root)).parts[0] for path in self.others}) > 1

    def describe_choice(self, cameras: Path | None) -> list[str]:
        """Return a list with a note that ``cameras`` are read and other cameras are not; empty without other cameras.

        The note names cameras that were tried before ``cameras``, and COLMAP models beside the model that is read.
        """
        if cameras is None or not self.others:
            return []
        paths = [path for path in (self.cameras, *self.others) if path is not None]
        place = paths.index(cameras)
        models = {path for path in filter(is_colmap, paths) if path.parent == cameras.parent}
        rejected = [*paths[:place], *(path for path in paths[place + 1 :] if {path, cameras} <= models)]
        if not rejected and not self.below:
            return []
        chosen, *others = (
            os.path.relpath(path, self.root) + f" ({count_images(path)} images)" for path in (cameras, *rejected)
        )
        contrast = f", not from {list_some(others)}" if others else ""
        text = f"cameras are read from {chosen}, since they fit the Gaussians{contrast}; --cameras names others"
        return [text.replace(" (0 images)", "")]

    @property
    def is_state(self) -> bool:
        """Return whether the scene is a state (``.gsm``), whose Gaussians belong to no pixels of photos."""
        return self.ply.suffix.lower() == STATE_ENDING

    @property
    def base(self) -> Path:
        """Path that names results.

        It is the scene's file, or ``scene.ply`` beside it if the scene has several files. If the file lies below a
        folder that the user named, it is a file in that folder, with the folder's name.
        """
        if self.folder is not None and self.folder != self.ply.parent:
            return self.folder / f"{Path(os.path.abspath(self.folder)).name}.ply"
        return self.ply.with_name("scene.ply") if self.parts else self.ply

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on several files that are read as one scene, and on cameras and photos outside the scene's folder."""
        notes = []
        if self.num_copies:
            notes.append(f"{self.num_copies + 1} files have the same bytes; {self.ply.name} is read")
        elif self.num_steps:
            notes.append(f"{self.ply.name} is the last of {self.num_steps + 1} steps of one training, and is read")
        elif self.parts:
            notes.append(f"{len(self.parts)} files are read as one scene: {self.ply.name} to {self.parts[-1].name}")
        if self.above:
            kinds = " and ".join(KINDS.get(option, option) for option, _ in self.above)
            words = shlex.join(word for option, path in self.above for word in (f"--{option}", str(path)))
            notes.append(f"{kinds} outside the scene's folder are not read; to read them, pass {words}")
        if self.below and self.cameras not in self.others:
            paths = list_some([*map(str, self.others)])
            option = shlex.join(["--cameras", str(self.others[0])])
            reason = "since several folders have some" if self.is_spread else "since no photo shows that they fit"
            notes.append(f"cameras in folders below are not read, {reason}: {paths}; to read them, pass {option}")
        return tuple(notes)


def find_scene_files(
    path: StrPath,
    *,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
    protect: StrPath | None = None,
    within: StrPath | None = None,
) -> SceneFiles:
    """Find a scene's files from its path. Files that the caller names, or excludes by "none", are not searched for.

    Folders are searched in this order:

    - the given folder;
    - the folder of the ``.ply``, and the folders above it up to the given folder. If the folder of the ``.ply`` is
      ``gs_ply/``, ``ply/`` or ``gaussians/``, also the folder above it. If the ``.ply`` is in
      ``point_cloud/iteration_n/``, also the folder that has ``point_cloud/``;
    - for cameras and photos, the folder of the file to which the ``.ply`` links;
    - for cameras and photos, the folders above the ``.ply`` up to ``within``;
    - the folders below the given folder, but only for cameras, and only if the folders listed before have no cameras.

    A folder with Gaussians is a scene, and no file in it belongs to another scene. Masks are searched for beside the
    photos that are read, and in the folders of the first two list items.

    In each folder the places of ``PLY_PLACES``, ``CAMERA_PLACES``, ``IMAGE_PLACES`` and ``MASK_PLACES`` are tried in
    their order. Cameras of a result, in ``NAME.cameras.json``, come first, but come last if they may belong to another
    file. Of several COLMAP models in one place, the model with the most images comes first. Cameras inside the ``.ply``
    precede cameras beside it. If no place has cameras, the only file that holds cameras is taken, whatever its name. If
    no file holds cameras, a file of cameras of an unsupported program is taken, and its reader names the program.
    Images inside an ``.npz`` of cameras precede a folder of images, because the network saw the images in the ``.npz``.
    A result of gsmerge is taken as the scene only if a folder has no other scene.

    Raises:
        SceneError: If there is no ``.ply``, if there are several scenes to choose from, or if a named file does not
            exist. Numbered files of views or parts are one scene, see ``docs/reference/formats.md``.
    """
    path = Path(path)
    given = {"cameras": cameras, "images": images, "masks": masks}
    if images is not None and images != NONE:
        check_photo_folder(Path(images))
    named = frozenset(name for name, value in {**given, "protect": protect}.items() if value is not None)
    camera_path, image_path, mask_path = map(named_path, given.values())
    protect = named_path(protect)
    for option, folder in (("masks", mask_path), ("protect", protect)):
        if folder is not None and not folder.is_dir():
            raise SceneError(folder, f"expected a folder of pictures for --{option}, found a file", "name its folder")
    if path.suffix.lower() == STATE_ENDING and not os.path.isdir(path):
        check_file(path)
        views_file = path if cameras is None and _holds_views(path) else None
        photos = image_path or (views_file if images is None else None)
        return SceneFiles(path, camera_path or views_file, photos, mask_path, protect, named=named)
    plys = [path]
    num_copies = 0
    if os.path.isdir(path):
        plys = find_plys(path, camera_path)
        num_copies = len(list_plys(path)) - len(plys)
    ply = plys[0]
    for part in plys:
        check_file(part)
        if part.suffix.lower() in SEVERAL_USES:
            _check_scene_file(part)
    own_roots, shared = _search_roots(path, ply, within)
    roots = [*own_roots, *shared]
    others = list[Path]()
    below = False
    if cameras is None:
        camera_path, others, below = _find_camera_paths(ply, roots)
    if images is None:
        if camera_path is not None and (
            camera_path.suffix == STATE_ENDING or (camera_path.suffix == ".npz" and holds_images(camera_path))
        ):
            image_path = camera_path
        else:
            image_path = _find_pictures("images", IMAGE_PLACES, roots, ply)
    if masks is None:
        photo_roots = filter((image_path or roots[0]).is_relative_to, roots)
        nearest = max(photo_roots, key=lambda root: len(root.parts), default=roots[0])
        beside_photos = nearest if images is None or image_path is None else image_path.parent
        mask_path = _find_pictures("masks", MASK_PLACES, [beside_photos, *own_roots], ply)
    parts = tuple(plys) if len(plys) > 1 else ()
    steps = [] if path == ply and within is None else list(_find_steps(list(ply.parent.glob("[!.]*"))).values())
    pictures = image_path, mask_path, protect
    files = SceneFiles(
        ply, camera_path, *pictures, parts=parts, num_copies=num_copies, num_steps=steps.count(ply), named=named,
        others=tuple(others), below=below, root=roots[0], folder=None if ply == path else path,
    )  # fmt: skip
    return replace(files, above=_find_above(files, own_roots))


def _find_camera_paths(ply: Path, roots: Sequence[Path]) -> tuple[Path | None, list[Path], bool]:
    """Return a scene's cameras or None, a list of further cameras, and whether these lie in folders below the scene.

    The cameras are in the order that :func:`find_scene_files` describes. Folders below the scene are searched only if
    there are no cameras beside the scene.
    """
    of_result = result_cameras(ply)
    if of_result is not None and _rate_camera_file(ply) == 2:
        return of_result, [], False
    beside = dict.fromkeys(
        path for root in roots for path in list_cameras(root) if not _is_in_other_scene(path, root, ply)
    )
    max_cameras = 8  # most cameras of a scene that are tried
    cameras = [*islice(beside, max_cameras)] or [*filter(None, map(find_other_cameras, roots))][:1]
    if cameras:
        return cameras[0], cameras[1:], False
    max_folders = 100  # most folders below a scene that are searched for cameras
    folders = list_folders(roots[0])[:max_folders]
    below = dict.fromkeys(p for top, _ in folders for p in list_cameras(top) if not _is_in_other_scene(p, top, ply))
    unread = next(filter(None, map(find_unread, roots)), None)
    return unread or of_result, [*islice(below, max_cameras)], bool(below)


def _find_pictures(option: str, places: Sequence[str], roots: Sequence[Path], ply: Path) -> Path | None:
    """Find the first of the ``places`` in ``roots`` that has pictures, but no pictures of another scene; or None.

    Raise SceneError, with a remedy by ``option``, if a place is a folder that cannot be read.
    """
    folders = list[tuple[Path, Path]]()
    for root, folder in ((root, root / place) for root in roots for place in places):
        try:
            os.scandir(folder).close()
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            remedy = f"make it readable, name another folder with --{option}, or say --{option} none"
            raise SceneError(folder, f"cannot be read ({error.strerror})", remedy) from error
        folders.append((root, folder))
    # If a folder has several scenes, each may have its own folder of pictures, with the name of the scene
    names = ply.stem, os.path.basename(os.path.realpath(ply.parent))
    for root, folder in [*((root, folder / name) for root, folder in folders for name in names), *folders]:
        picture_folders = {picture.parent for picture in list_images(folder) if not is_drawn(picture)}
        if picture_folders and not any(_is_in_other_scene(place, root, ply) for place in picture_folders):
            return folder
    return None


def _is_in_other_scene(path: Path, root: Path, ply: Path) -> bool:
    """Return whether a path belongs to another scene than ``ply``.

    A folder below ``root`` that has Gaussians, but not ``ply``, is another scene. All files in another scene's folder
    belong to that scene.
    """
    folders = [place for place in (path, *path.parents) if place != root and place.is_relative_to(root)]
    scenes = [_plys_in(place) or other_plys(place / SCENES_PLACE) for place in folders if place.is_dir()]
    return any(plys and os.path.realpath(ply) not in map(os.path.realpath, plys) for plys in scenes)


def _find_above(files: SceneFiles, roots: Sequence[Path]) -> tuple[tuple[str, Path], ...]:
    """Search the folder above a scene's own folders ``roots`` for the photos, cameras and masks that the scene lacks.

    Files of a neighbouring scene do not count. Masks count only if they have the names of the scene's photos. Return
    each path that was found, after its option.
    """
    # The uppermost folder is found by ``min``, since the path of a folder sorts before the paths in it
    folder = min(filter(Path(os.path.realpath(files.ply)).is_relative_to, roots), default=roots[0]).parent
    places = dict[str, Path | None]()

    def search() -> None:
        """Search the folder; raise SceneError or OSError if something in it cannot be read."""
        if files.images is None and "images" not in files.named:
            places["images"] = _find_pictures("images", IMAGE_PLACES, [folder], files.ply)
        if files.cameras is None and "cameras" not in files.named:
            places["cameras"] = next(
                (path for path in list_cameras(folder) if not _is_in_other_scene(path, folder, files.ply)), None
            )
        masks = _find_pictures("masks", MASK_PLACES, [folder], files.ply)
        if masks and files.images and files.masks is None and "masks" not in files.named:
            match_masks(masks, [*map(str, list_images(files.images))])  # SceneError if no mask has the name of a photo
            places["masks"] = masks

    with suppress(OSError):
        attempt(search)
    return tuple((option, path) for option, path in places.items() if path is not None and path not in roots)


def _search_roots(path: Path, ply: Path, within: StrPath | None) -> tuple[list[Path], list[Path]]:
    """Return a scene's own folders, and folders that other scenes may share; :func:`find_scene_files` lists both."""
    given_folder = path if ply != path else ply.parent
    folder = Path(os.path.realpath(ply.parent))
    program_folders = [folder.parent] * (folder.name in ("gs_ply", "ply", SCENES_PLACE))
    if folder.name.startswith("iteration_") and folder.parent.name == "point_cloud":
        program_folders = [folder.parent.parent]
    own = [Path(os.path.realpath(given_folder)), folder, *program_folders]
    own += _list_between(folder, Path(os.path.realpath(path)))
    above = _list_between(folder, Path(os.path.realpath(within or folder)))
    # A folder above is left out if it has a scene with a usual name, since its photos and cameras belong to that scene
    shared = [Path(os.path.realpath(ply)).parent, *(place for place in above if named_ply(place) is None)]
    return list(dict.fromkeys(own)), [place for place in dict.fromkeys(shared) if place not in own]


def _list_between(folder: Path, top: Path) -> list[Path]:
    """List the folders above a folder up to ``top``, the nearest first; empty if ``top`` is not above ``folder``."""
    return [above for above in folder.parents if above.is_relative_to(top)] if folder.is_relative_to(top) else []


def scene_title(ply: Path) -> str:
    """Return a scene's name for a page: the name of the file, or of its folder if the program names all files alike."""
    path = ply.absolute().with_name(ply.stem.removesuffix(".compact")).as_posix()
    return Path(_USUAL_END.sub("", path)).name or ply.stem


def result_cameras(ply: Path) -> Path | None:
    """Find the cameras that gsmerge wrote beside a result; None if there are none.

    For a level of detail that has no camera file, the camera file of the full result is taken. If a ``.ply`` of another
    program has a result of the same name beside it, such as ``scene.sog`` beside ``scene.ply``, the cameras belong to
    the result.
    """
    names = ply.name, _LEVEL.sub("", ply.name)
    beside = (viewer_cameras_path(ply.with_name(name)) for name in names)
    cameras = next((path for path in beside if path.is_file()), None)
    return None if cameras is None or not _rate_camera_file(ply) else cameras


def _rate_camera_file(ply: Path) -> int:
    """Rate by 0 to 2 points how surely ``NAME.cameras.json`` has the cameras of the file ``ply`` called NAME.

    A ``.ply`` gets one point if gsmerge wrote it, and one point if no file of another format has the same name. A
    result gets both points. A file of another format than ``.ply`` gets both points, too, since its header does not say
    what it is.
    """
    if find_format(ply).ending != ".ply" or header_content(ply) == "result":
        return 2
    namesakes = (ply.with_suffix(ending) for ending in OUTPUT_FORMATS if ending != ".ply")
    return is_from_gsmerge(read_header(ply).comments) + (not any(path.is_file() for path in namesakes))


def named_path(path: StrPath | None) -> Path | None:
    """Return a path that the caller named, None for None and "none"; raise SceneError if the path does not exist."""
    if path is None or path == NONE:
        return None
    if not os.path.exists(path):
        raise no_such_path(path)
    if not os.path.isdir(path):
        check_program(Path(path))
        check_file(Path(path))
    return Path(path)


def find_plys(folder: Path, cameras: Path | None = None) -> list[Path]:
    """Find the file of a folder's only scene, or the files of all parts of that scene, in order.

    If all files have the same bytes, only the first file is returned. Errors are those of :func:`find_scene_files`.
    """
    plys = list_plys(folder)
    if not plys:
        raise _no_gaussians(folder)
    if len(plys) == 1:
        return plys
    in_one_folder = len({path.parent for path in plys}) == 1
    are_numbered = in_one_folder and all(_NUMBERED.fullmatch(path.name) for path in plys)
    with suppress(OSError):  # numbered files may be copies: Flash3D writes one for each rendered view
        if are_numbered and all(filecmp.cmp(plys[0], path, shallow=False) for path in plys[1:]):
            return plys[:1]
    parts = _order_parts(folder, plys, cameras or find_cameras(folder)) if in_one_folder else None
    if parts is not None:
        return parts
    # several scenes, or moments or parts of one; the error has the commands for each
    start = plys[0].parent if in_one_folder else folder
    problem = f"expected one .ply file in the folder, found {len(plys)}"
    names = ", ".join(path.relative_to(start).as_posix() for path in plys[:4]) + ", ..." * (len(plys) > 4)
    if not are_numbered:
        raise SceneError(folder, f"{problem} ({names})", "name one, or give the folder to gsmerge batch")
    counts = {header_counts(path)[0] for path in plys[:_MAX_HEADERS]}
    kind = f"moments of {counts.pop():,} Gaussians each" if len(counts) == 1 else "moments or parts"
    calls = f"gsmerge batch {start} for all moments, or gsmerge convert {start}/*.ply one.ply to join parts of a scene"
    raise SceneError(folder, f"{problem} ({names}), numbered like {kind}", f"name one, or run {calls}")


def list_plys(folder: Path) -> list[Path]:
    """List the files that may be a folder's scene.

    Of the following kinds, all files of the first kind that the folder has are listed:

    1. the ``.ply`` with a usual name, or else all other scenes in the folder;
    2. files in ``gaussians/``;
    3. scenes in folders below;
    4. results of gsmerge;
    5. the ``meta.json`` of a ``.sog``;
    6. a file with a usual name but without Gaussians, so that the reader reports what the file lacks.
    """
    plys = _plys_in(folder) or other_plys(folder / SCENES_PLACE)
    below = [] if plys else [place for place, names in _walk_down(folder, links=False) if names is None]
    plys = plys or [ply for place in natural_order(below) for ply in _plys_in(place)]
    plys = plys or [
        path
        for path in natural_order(folder.glob("[!.]*.ply"))[:_MAX_HEADERS]
        if _RESULT.search(path.name) or header_content(path) == "result"
    ]
    plys = plys or [path for path in [folder / META] if path.is_file() and may_hold_gaussians(path)]
    return plys or [folder / place for place in PLY_PLACES if (folder / place).is_file()][:1]


def _plys_in(folder: Path) -> list[Path]:
    """List the files in a folder that may be its scene: the file with a usual name, or else all other scenes."""
    named = named_ply(folder)
    return other_plys(folder) if named is None else [named]


def list_folders(folder: Path) -> list[tuple[Path, list[str]]]:
    """List a folder and the folders below it, each with the names of its files. The nearest folders come first.

    The depth is limited. Folders of masks and of held-out views, and folders with too many entries, are left out.
    Scenes, which are folders with Gaussians of their own, and all folders below scenes are left out, too.
    """
    return [(place, names) for place, names in _walk_down(folder, links=True) if names is not None]


def _walk_down(folder: Path, *, links: bool) -> list[tuple[Path, list[str] | None]]:
    """List folders as :func:`list_folders` does, and also scenes, which have None in place of the names of files.

    With ``links``, links to folders are followed, and folders with too many entries are left out. Without ``links``,
    the list is empty if there are too many entries.
    """
    folders = list[tuple[Path, list[str] | None]]()
    places = [(folder, 0)]
    num_entries = 0
    max_depth = 3  # most levels of folders that are searched below a folder without a scene
    for place, depth in places:  # the loop appends to this list
        with suppress(OSError), os.scandir(place) as scan:
            if depth and _plys_in(place):
                folders.append((place, None))
                continue
            entries = sorted(islice(scan, _MAX_ENTRIES + 1 - num_entries), key=lambda entry: entry.name)
            if num_entries + len(entries) > _MAX_ENTRIES:
                if links:
                    continue
                return []
            num_entries += len(entries)
            folders.append((place, [entry.name for entry in entries if entry.is_file()]))
            inner = {entry.name for entry in entries if entry.is_dir(follow_symlinks=links)}
            searched = {name for name in inner if name[0] != "."} - _OTHER_PICTURES if depth < max_depth else ()
            places += [(place / name, depth + 1) for name in sorted(searched)]
    return folders


def _order_parts(folder: Path, plys: Sequence[Path], cameras: Path | None) -> list[Path] | None:
    """Order files by number if each is a view or a part of one scene; return None if they are several scenes.

    Files belong to one scene if their names say so, or if there are as many cameras as files. If a file holds a camera,
    the files are several scenes, since each file then has a different frame. Raise SceneError if a part is missing.
    """
    matches = [_NUMBERED.fullmatch(path.name) for path in plys]
    stems = {match[1].lower() if match else "" for match in matches}  # names without their numbers
    path_of = {int(match[2]): path for match, path in zip(matches, plys, strict=True) if match}
    if len(stems) > 1 or len(path_of) < len(plys):
        return None
    numbers = sorted(path_of)
    if re.split(r"[-_. ]", stems.pop())[-1] in _PARTS:
        missing = next((low + 1 for low, high in pairwise(numbers) if high > low + 1), None)
        if missing is not None:
            first = path_of[numbers[0]].name
            last = path_of[numbers[-1]].name
            problem = f"expected all parts from {first} to {last}, found no part with the number {missing}"
            raise SceneError(folder, problem, "add the missing part, or name one of the files")
    elif plys[0].parent.name == SCENES_PLACE or cameras is None or len({header_counts(path) for path in plys}) > 1:
        return None
    else:
        stored = attempt(read_cameras, cameras)
        if isinstance(stored, SceneError) or len(stored) != len(plys):
            return None
    inside = (attempt(read_sharp_camera, path) for path in plys)  # the reader of a file reports a damaged camera
    if any(not isinstance(camera, SceneError | None) for camera in inside):
        return None
    return [path_of[number] for number in numbers]


def named_ply(folder: Path) -> Path | None:
    """Find the scene with a usual name in a folder, or else the scene trained with the most steps; or None."""
    for place in PLY_PLACES:
        if (folder / place).is_file() and _is_scene(folder / place):
            return folder / place
    patterns = (*TRAINED_PLACES, *(["point_cloud_*.ply"] if folder.name == "ply" else []))
    trained = {path: _STEPS.search(str(path)) for pattern in patterns for path in folder.glob(pattern)}
    steps = {path: int(match[1]) for path, match in trained.items() if match is not None}
    return next((path for path in sorted(steps, key=lambda path: -steps[path]) if _is_scene(path)), None)


def other_plys(folder: Path) -> list[Path]:
    """List the ``.ply`` files in a folder, not below it, that are neither results nor point clouds.

    In a folder without such a ``.ply``, list the only file of another format if that file may have Gaussians. Of the
    steps of a training, only the last counts.
    """
    plys = natural_order(folder.glob("[!.]*.ply"))
    scenes = [*(path for path in plys[:_MAX_HEADERS] if _is_scene(path)), *plys[_MAX_HEADERS:]]
    packed = [] if scenes else [p for p in folder.glob("[!.]*") if p.suffix in _PACKED]
    earlier = _find_steps(scenes or packed)
    scenes, packed = ([path for path in paths if path not in earlier] for paths in (scenes, packed))
    return packed if len(packed) == 1 and may_hold_gaussians(packed[0]) else scenes


def _find_steps(paths: Sequence[Path]) -> dict[Path, Path]:
    """Map files of earlier steps of a training to the file of its last step; their names tell them from other numbers.

    Trainers save at multiples of hundreds, or one less where steps count from 0, and at the end. Moments and parts have
    numbers in a row. Without a word such as "export", the last number has to be at least 1,000.
    """
    groups = dict[tuple[str, str], dict[int, Path]]()  # name without the number, and ending -> number -> file
    for path in paths:
        match = _EXPORT.fullmatch(path.name)
        if match is not None:
            number = int(match[2]) * (1000 if match[3][0] in "kK" else 1)
            groups.setdefault((match[1].lower(), match[3]), {})[number] = path
    last_steps = dict[Path, Path]()
    unit = 100  # steps
    for (name, _), path_of in groups.items():
        *early, last = sorted(path_of)
        word = re.split(r"[-_. ]", name)[-1]
        is_training = word in _STEP_WORDS and (len(early) > 1 or last - sum(early) >= unit)
        numbers = early if is_training else [*early, last]  # a training may end at any step
        is_known = is_training or (word not in _OTHER_WORDS and last >= 10 * unit)
        if is_known and {number % unit for number in numbers} in ({0}, {unit - 1}):
            last_steps |= dict.fromkeys((path_of[number] for number in early), path_of[last])
    return last_steps


def _is_scene(path: Path) -> bool:
    """Return whether a ``.ply`` may be a scene: neither its name nor its header shows a result or a point cloud."""
    is_other = path.name in _POINT_CLOUDS or _RESULT.search(path.name)
    return not is_other and header_content(path) == "Gaussians"
