"""Draw scenes: a panel beside photos, a picture for each camera, or a clip along a path."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.drawing.camera_path import parse_camera_path, sample_path, viewing_depth
from gsmerge.drawing.clip import (
    FOLDER_HINT,
    H264,
    MAX_GIF_PIXELS,
    MAX_VIDEO_PIXELS,
    draw_swipe,
    make_captions,
    stored_size,
    swipe_borders,
    write_clip,
)
from gsmerge.drawing.preview import (
    BytePicture,
    contact_sheet,
    lay_on_chequer,
    outside_pictures,
    save_picture,
    to_picture,
    view_pictures,
)
from gsmerge.drawing.render_views import doubt_empty, near_plane
from gsmerge.errors import SceneError, UsageError, name_notes, split_notes
from gsmerge.frozen import dataclass, replace
from gsmerge.io import file_notes, read_cameras, read_gaussians, to_cameras
from gsmerge.io.atomic import atomic_outputs, common_mode
from gsmerge.io.cameras.camera_file import sizes_of
from gsmerge.io.cameras.read_cameras import read_sharp_camera
from gsmerge.io.formats.read_gaussians import FileInfo
from gsmerge.io.image_names import IMAGE_SUFFIXES
from gsmerge.method.geometry.views import pick_views, subset
from gsmerge.method.raster import render_in_batches
from gsmerge.method.raster.photos import NEAR_PLANE
from gsmerge.method.viewpoints.place_cameras import add_views
from gsmerge.prepare.prepare_scene import scored_pictures
from gsmerge.reading.exporters import NO_HINTS, ReadHints
from gsmerge.reading.held_out import read_into_frame
from gsmerge.reading.photos.scene_photos import LEFT_OUT
from gsmerge.reading.read_scene import Loaded, move_cameras_to_scene, read_gaussian_file
from gsmerge.reading.scene_files import SceneFiles, find_scene_files
from gsmerge.runtime.memory import human_bytes
from gsmerge.runtime.record import Progress, record_run
from gsmerge.runtime.threads import use_threads
from gsmerge.scoring.sizes import fill_cameras, fill_photo, shrink_cameras
from gsmerge.settings.files import CLIPS, GIF, PICTURES, TRANSPARENT
from gsmerge.settings.reading import OpacityChoice
from gsmerge.settings.setting import suggest_name
from gsmerge.types import Cameras, Gaussians, StrPath

SECONDS = 4  # least duration of a clip
VIEW_FRAMES = 4  # least number of frames for each view of a spline
# frames per second
FPS = 30.0
GIF_FPS = 12.5
GIF_SIDE = 640  # largest side of a GIF if the option size is not given, pixels
PLACED_SIZE = 1280, 720  # width and height of pictures from placed cameras, pixels


@dataclass(frozen=True)
class DrawOptions:
    """Options of a drawing: which scenes to read and how, what to draw, and where to write it."""

    files: SceneFiles  # files of the first scene
    paths: Sequence[Path]  # paths of all scenes, as the user named them
    framing: SceneFiles  # files of the scene into whose frame the cameras are moved
    output: Path  # a picture, a video, or a folder for pictures
    opacity: OpacityChoice = "auto"
    hints: ReadHints = NO_HINTS
    views: int | str | None = None  # largest number of views, or the name of one view; None: all, but four in a panel
    path: str | None = None  # text of gsmerge.drawing.camera_path.parse_camera_path, or a file of cameras
    frames: int | None = None  # frames of a path; None: enough for SECONDS; for a spline also VIEW_FRAMES per view
    size: tuple[int, int] | None = None  # width and height of a picture; None: the size of the cameras
    # Grey level in [0, 1]; None: nothing, so that a .png or .webp of one scene is transparent, and other pictures have
    # a chequered ground
    background: float | None = None

    def choose(self, names: Sequence[str], most: int | None = None) -> list[int]:
        """Choose the ids of the views to draw: as the option ``views`` says, otherwise at most ``most``, or all."""
        if isinstance(self.views, str):
            return [find_view(self.views, names)]
        return pick_views(len(names), self.views or most or len(names))

    @property
    def fps(self) -> float:
        """Frames per second."""
        return GIF_FPS if self.output.suffix.lower() == GIF else FPS

    def resize(self, cameras: Cameras) -> Cameras:
        """Resize and crop the images of cameras to the size of the pictures."""
        if self.size is not None:
            return fill_cameras(cameras, *self.size)
        return shrink_cameras(cameras, GIF_SIDE) if self.output.suffix.lower() == GIF else cameras


@dataclass(frozen=True, eq=False)
class Drawing:
    """A prepared drawing: paths, facts, and a function that yields the pictures one by one."""

    paths: list[Path]  # files of the pictures, or of the video
    facts: dict[str, Any]  # facts for the report
    draw: Callable[[int], Iterator[BytePicture]]  # number of threads -> pictures; each thread has one view in memory
    mode: int = 0o666  # access rights of new files: at most those of the photos that are drawn


@dataclass(frozen=True, eq=False)
class DrawnScenes:
    """Scenes to draw together. All scenes share the frame of one scene, and are drawn in its views."""

    scenes: list[tuple[Path, Gaussians]]
    infos: list[FileInfo]  # facts about their files
    notes: list[str]
    load: Loaded  # the scene whose frame and views are used
    near: float  # near plane for the views, world units

    def counts(self) -> dict[str, int]:
        """Return the number of Gaussians of every scene by its path."""
        return {str(path): len(gaussians) for path, gaussians in self.scenes}

    def draw(
        self,
        cameras: Cameras,
        options: DrawOptions,
        threads: int,
        near: float,
        borders: Sequence[Sequence[int]] | None = None,
        *,
        transparent: bool = False,
    ) -> Iterator[tuple[BytePicture, ...]]:
        """Yield, for each camera, the 8-bit pictures of all scenes, with one view per thread in memory.

        With ``transparent`` and without a background, pictures have alpha; otherwise a chequered ground replaces it.
        ``borders`` are the borders in each picture, see :func:`gsmerge.drawing.clip.swipe_borders`. Scene i is shown
        between the borders i and i + 1. Other columns of its picture need not be drawn, and may show the background
        only.
        """
        on_chequer = options.background is None and not transparent
        convert = np.asarray if on_chequer else to_picture
        settings: dict[str, Any] = {"at_once": threads, "near": near, "convert": convert}
        drawn = (
            render_in_batches(
                gaussians,
                replace(cameras, antialiased=info.antialiased),
                options.background,
                columns=None if borders is None else [(row[i], row[i + 1]) for row in borders],
                **settings,
            )
            for i, ((_, gaussians), info) in enumerate(zip(self.scenes, self.infos, strict=True))
        )
        for pictures in zip(*drawn, strict=True):
            if on_chequer:
                yield tuple(to_picture(lay_on_chequer(image[..., :3], 1 - image[..., 3])) for image in pictures)
            else:
                yield pictures

    def note_empty(self, cameras: Cameras, near: float, names: Sequence[str]) -> None:
        """Note in which pictures of the cameras no Gaussian is seen, by the ``names`` of the pictures."""
        for path, gaussians in self.scenes:
            doubts = doubt_empty(gaussians, cameras, near, names)
            self.notes.extend(doubts if len(self.scenes) == 1 else name_notes(path, doubts))


def frame_files(files: SceneFiles, cameras: StrPath | None, images: StrPath | None) -> SceneFiles:
    """Find the files of the scene that defines the frame of the cameras.

    For a compacted scene this is the source ``NAME.ply``, if it lies beside the compacted scene. For any other scene it
    is the scene itself. ``cameras`` and ``images`` are the options of the user.
    """
    match = re.fullmatch(r"(.+)\.compact(\.level\d+)?(\.compressed)?\.(ply|spz|sog|splat|glb)", files.ply.name)
    if match is None or not (source := files.ply.with_name(f"{match[1]}.ply")).is_file():
        return files
    framing = find_scene_files(source, cameras=cameras, images=images)
    return framing if framing.cameras is not None else replace(framing, cameras=files.cameras)


def prepare_panel(options: DrawOptions) -> Drawing:
    """Prepare one picture with a column for the photos and for each scene, and a row for each view.

    The last row is a view from outside.
    """
    group = _read_scenes(options, photos=True)
    scene = group.load.scene
    cameras = options.resize(scene.cameras)
    photos = scene.images
    pictured = scene.photo_views
    panel_views = 4  # rows of a panel
    ids = options.choose(scene.names, panel_views)
    names = [re.split(r"[\\/]", scene.names[i])[-1] for i in ids]
    group.note_empty(cameras[ids], group.near, names)

    def draw(_: int) -> Iterator[BytePicture]:
        """Yield the panel: rows of photos and renders, then a row from outside."""
        named = [(path.name, gaussians) for path, gaussians in group.scenes]
        shown: list[BytePicture | None] | None = None
        if photos is not None:
            shown = [photos[i] if i in pictured else None for i in ids]
        if shown and options.size:
            shown = [None if photo is None else fill_photo(photo, *options.size) for photo in shown]
        marks = [info.antialiased for info in group.infos]
        masks = None
        if shown and not options.size:
            counts = scored_pictures(scene)[0].masks  # of an object before one colour, the object counts
            masks = None if counts is None else [counts[i] for i in ids]
        looks: dict[str, Any] = {"marks": marks, "background": options.background, "near": group.near}
        rows = view_pictures(named, cameras[ids], shown, names, masks=masks, **looks)
        # If the scene has no cameras, gsmerge placed the views, the first half around the scene, the others inside it
        outer_cameras = cameras if group.load.cameras is not None else cameras[: len(cameras) // 2]
        outside = outside_pictures(named, outer_cameras, photos=shown is not None, **looks)
        yield contact_sheet([*rows, outside])

    facts = {"scenes": group.counts(), "views": ids, "photos": len(pictured) > 0, "notes": group.notes}
    return Drawing([options.output], facts, draw, common_mode(options.framing.paths))


def prepare_pictures(options: DrawOptions) -> Drawing:
    """Prepare a picture for each camera, with the scenes side by side. An output that is no folder gets one camera."""
    group = _read_scenes(options, photos=False)
    is_folder = options.output.suffix.lower() not in PICTURES
    ids = options.choose(group.load.scene.names) if is_folder or options.views else [0]
    views, stems = options.resize(group.load.scene.cameras[ids]), picture_stems(group.load.scene.names)
    group.note_empty(views, group.near, [stems[i] for i in ids])
    names = [f"{path.name}: {len(gaussians):,}" for path, gaussians in group.scenes]

    def draw(threads: int) -> Iterator[BytePicture]:
        """Yield a picture for each camera. Several scenes are side by side, with their names."""
        transparent = len(group.scenes) == 1 and (is_folder or options.output.suffix.lower() in TRANSPARENT)
        for pictures in group.draw(views, options, threads, group.near, transparent=transparent):
            yield contact_sheet([list(zip(names, pictures, strict=True))]) if len(pictures) > 1 else pictures[0]

    facts = {"width": views.width, "height": views.height, "scenes": group.counts(), "views": ids, "notes": group.notes}
    return Drawing([options.output / f"{stems[i]}.png" for i in ids] if is_folder else [options.output], facts, draw)


def prepare_clip(options: DrawOptions) -> Drawing:
    """Prepare a clip along a path, with moving lines between the scenes. An output folder gets single frames."""
    group, cameras, near, ids = _make_path(options)
    cameras = options.resize(cameras)
    group.note_empty(cameras, near, [f"frame {i}" for i in range(len(cameras))])
    paths = [path.absolute() for path, _ in group.scenes]
    repeats_names = len({path.name for path in paths}) < len(paths)
    texts = [
        (
            "/".join(path.parts[-2:]) if repeats_names else path.name,
            f"{len(gaussians):,} Gaussians",
            human_bytes(info.file_bytes),
        )
        for path, (_, gaussians), info in zip(paths, group.scenes, group.infos, strict=True)
    ]

    def draw(threads: int) -> Iterator[BytePicture]:
        """Yield the frames of the clip. Several scenes share a frame, and have captions."""
        if len(texts) == 1:
            yield from (picture for (picture,) in group.draw(cameras, options, threads, near))
            return
        captions = make_captions(texts, cameras.width, cameras.height)
        borders = swipe_borders(len(texts), len(cameras), options.fps, cameras.width)
        for pictures, row in zip(group.draw(cameras, options, threads, near, borders), borders, strict=True):
            yield draw_swipe(pictures, row, captions)

    facts = {"views": ids, "notes": group.notes, "scenes": group.counts(), "path": options.path}
    facts |= {"frames": len(cameras), "width": cameras.width, "height": cameras.height}
    if options.output.suffix.lower() not in CLIPS:
        return Drawing([options.output / f"frame_{i:05d}.png" for i in range(len(cameras))], facts, draw)
    # A clip with more or larger frames would take too much memory to encode
    if cameras.width * cameras.height > MAX_VIDEO_PIXELS:
        size = f"{cameras.width} x {cameras.height}"
        problem = f"expected at most {MAX_VIDEO_PIXELS:,} pixels per frame of a video, found {size}"
        raise SceneError(options.output, problem, FOLDER_HINT)
    if options.output.suffix.lower() == GIF and len(cameras) * cameras.width * cameras.height > MAX_GIF_PIXELS:
        size = f"{len(cameras)} x {cameras.width} x {cameras.height}"
        problem = f"expected at most {MAX_GIF_PIXELS:,} pixels in a GIF, found {size}"
        raise SceneError(options.output, problem, "lower --size or --frames, or name a .mp4")
    width, height = stored_size(options.output, cameras.width, cameras.height)
    if (width, height) != (cameras.width, cameras.height):
        group.notes.append(
            f"frames of {cameras.width} x {cameras.height} are written as {width} x {height}, with the last row or"
            " column repeated, since a video has even sides"
        )
    return Drawing([options.output], facts | {"width": width, "height": height, "fps": options.fps}, draw)


def _make_path(options: DrawOptions) -> tuple[DrawnScenes, Cameras, float, list[int]]:
    """Read the scenes and make the cameras of a path, or read these cameras from a file.

    Returns the scenes, the cameras, the near plane (world units), and the ids of the views from which the path is made.
    """
    assert options.path is not None
    path = parse_camera_path(options.path)
    file = None if path else Path(options.path)
    framing = options.framing
    has_own = framing.cameras is not None or framing.images is not None or read_sharp_camera(framing.ply) is not None
    is_scene_file = file is not None and not has_own  # the only cameras of the scene are in the path's file
    if is_scene_file:
        options = replace(options, framing=replace(options.framing, cameras=file))
    group = _read_scenes(options, photos=False)
    cameras = scene_cameras = group.load.scene.cameras
    if file is not None and not is_scene_file:  # cameras without image sizes get the scene's size
        stored = read_cameras(file) if group.load.cameras is None else read_into_frame(group.load, file)[0]
        size = None if sizes_of(stored) else (scene_cameras.width, scene_cameras.height)
        cameras = to_cameras(replace(stored, lenses=()), size)
    assert not isinstance(options.views, str)
    ids = pick_views(len(cameras), options.views or len(cameras))
    cameras = cameras[ids]
    depth = viewing_depth(cameras if file is None else scene_cameras, group.scenes[0][1].means)
    if path is not None:
        min_frames = VIEW_FRAMES * len(ids) if path.kind == "spline" else 0
        try:
            count = options.frames or max(round(SECONDS * options.fps), min_frames)
            cameras = sample_path(path, cameras, depth, count)
        except ValueError as error:
            raise UsageError(str(error)) from error
    return group, cameras, NEAR_PLANE * depth, ids


DRAWINGS = {"panel": prepare_panel, "views": prepare_pictures, "path": prepare_clip}


def _read_scenes(options: DrawOptions, *, photos: bool) -> DrawnScenes:
    """Read the scenes, and from ``options.framing`` the cameras that show the scenes.

    If ``photos``, also read the photos of these cameras.
    If there are no cameras, views are placed around the scene, and if ``photos`` also inside it.
    """
    files = options.files
    framing = options.framing
    paths = options.paths
    first_ply = read_gaussian_file(files, opacity=options.opacity, hints=options.hints)
    hints: dict[str, Any] = {"scales": options.hints.scales, "colors": options.hints.colors}
    plys = [read_gaussians(path, opacity=options.opacity, **hints) for path in paths[1:]]
    same_file = framing.ply == files.ply
    framing_ply = first_ply if same_file else read_gaussian_file(framing, opacity="auto", hints=NO_HINTS)
    load = move_cameras_to_scene(framing_ply, framing, hints=options.hints, photos=photos)
    if len(load.scene) == 0:
        placed = f"no cameras: views are placed {'around and inside' if photos else 'around'} the scene"
        with record_run() as record:
            scene = add_views(load.scene, shown=True, placed=placed)
        scene = scene if photos else subset(scene, range(len(scene) // 2))  # the other views are inside the scene
        scene = replace(scene, cameras=fill_cameras(scene.cameras, *PLACED_SIZE))
        load = replace(load, scene=scene, notes=(*load.notes, *record.notes))
    if not photos:  # what is wrong with them does not matter
        load = replace(load, notes=tuple(split_notes(load.notes, LEFT_OUT)[1]))
    scenes = [load.scene.file_gaussians if same_file else first_ply.gaussians, *(ply.gaussians for ply in plys)]
    notes = [[*([] if same_file else file_notes(first_ply.info)), *load.notes], *(file_notes(ply.info) for ply in plys)]
    notes_with_paths = [note for path, texts in zip(paths, notes, strict=True) for note in name_notes(path, texts)]
    infos = [file.info for file in (first_ply, *plys)]
    near = near_plane(scenes[0], load.scene.cameras)
    shown_notes = notes_with_paths if plys else list(notes[0])
    return DrawnScenes(list(zip(paths, scenes, strict=True)), infos, shown_notes, load, near)


def find_view(view: str, names: Sequence[str]) -> int:
    """Return the id of the view of this name, with or without folders, ending and leading zeros.

    Raises UsageError if no view or several views have the name.
    """
    stems = picture_stems(names)
    number = picture_stems([view])[0].lstrip("0")
    ids = [i for i, name in enumerate(names) if view in (name, Path(name).name, stems[i])]
    ids = ids or [i for i, stem in enumerate(stems) if stem.lstrip("0") == number]
    if len(ids) != 1:
        problem = f"{len(ids)} views of this name" if ids else "no view of this name"
        problem += suggest_name(view, [*stems, *names])
        raise UsageError(f"--views {view}: expected a number or a name of a view such as {stems[0]}, found {problem}")
    return ids[0]


def picture_stems(names: Sequence[str]) -> list[str]:
    """Choose a file name without ending for each view, all different.

    The names of the images are used if all differ, otherwise whole paths joined by ``_``. If whole paths are equal as
    well, views are numbered.
    """
    paths = []
    for name in names:
        words = [word for word in re.split(r"[\\/]+", name) if word not in ("", ".", "..")]
        *folders, file_name = words or ["view"]
        stem, dot, suffix = file_name.rpartition(".")
        is_image = stem and f"{dot}{suffix}".lower() in IMAGE_SUFFIXES
        paths.append([*folders, stem if is_image else file_name])
    numbers = [[f"view_{i:03d}"] for i in range(len(names))]
    for candidates in ([path[-1:] for path in paths], paths, numbers):
        stems = ["_".join(path) for path in candidates]
        if len({stem.lower() for stem in stems}) == len(stems):  # some file systems ignore case
            break
    return stems


def write_drawing(drawing: Drawing, *, overwrite: bool, progress: Progress) -> dict[str, Any]:
    """Draw and write the pictures, and make folders as needed; return the facts that only writing gives."""
    total, fps = drawing.facts.get("frames", len(drawing.paths)), drawing.facts.get("fps")

    def report_progress(pictures: Iterator[BytePicture]) -> Iterator[BytePicture]:
        """Yield the pictures, and report each after it was written."""
        for done, picture in enumerate(pictures, 1):
            yield picture
            progress("render", done, total)

    with use_threads() as at_once:
        pictures = report_progress(drawing.draw(at_once))
        if fps is not None:
            return {"encoding": write_clip(drawing.paths[0], pictures, fps, overwrite=overwrite)}
        with atomic_outputs(overwrite=overwrite, mode=drawing.mode) as add:
            for path, picture in zip(drawing.paths, pictures, strict=True):
                save_picture(add(path), picture, overwrite=overwrite)
    return {}


def drawing_line(document: Mapping[str, Any]) -> str:
    """Describe a finished drawing in one line, from the report of the command."""
    if "frames" in document:
        line = f"{document['frames']} frames of {document['width']} x {document['height']}"
        line += f", {document['frames'] / document['fps']:.1f} s" if "fps" in document else ""
        if "encoding" not in document:
            return line
        is_less_played = document["encoding"] != H264[0] and document["pictures"][0].lower().endswith(".mp4")
        hint = ", which not all programs play; with ffmpeg on the PATH it would be H.264" if is_less_played else ""
        return f"{line}, {document['encoding']}{hint}"
    count = len(document["pictures"])
    views = len(document["views"])
    return f"{count} picture{'' if count == 1 else 's'} of {views} view{'' if views == 1 else 's'}"
