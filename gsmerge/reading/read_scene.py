"""Read a scene from its files: its Gaussians, the pixels of their rows, its cameras and its photos."""

from __future__ import annotations

import warnings
from typing import Any

from gsmerge.errors import Doubt, DoubtWarning, SceneError, attempt, name_notes
from gsmerge.frozen import replace
from gsmerge.io.cameras.camera_file import to_cameras
from gsmerge.io.formats.read_gaussians import GaussianFile, read_gaussians, read_parts
from gsmerge.io.formats.table import PLY
from gsmerge.io.photo_files import NO_IMAGES, as_floats, photo_size
from gsmerge.reading.alignment import AlignmentResult, check_cameras, check_pixels
from gsmerge.reading.candidates import list_candidates, parse_views, read_scene_cameras
from gsmerge.reading.choice import Choice
from gsmerge.reading.choose import (
    Evidence,
    certainly_fits,
    choose,
    explain_refusal,
    give_reasons,
    is_needed,
    release_spare,
)
from gsmerge.reading.examine import examine
from gsmerge.reading.exporters import NO_HINTS, ReadHints, find_exporter, make_hints
from gsmerge.reading.loaded import Loaded
from gsmerge.reading.make_scene import Placed, add_larger_and_masks, check_hints, make_scene
from gsmerge.reading.photos.scene_photos import read_stored_photos
from gsmerge.reading.scene_files import SceneFiles, find_scene_files
from gsmerge.reading.take_gaussians import confirm_colors
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.reading import OpacityChoice
from gsmerge.types import Scene, StrPath

SUMMED_FACTS = ("file_bytes", "num_nonfinite")  # facts about files that are added up if scenes are joined


@check_arguments
def read_scene(
    path: StrPath,
    *more: StrPath,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
    protect: StrPath | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Scene:
    """Read a scene: its ``.ply``, and its cameras and images if there are any.

    The pixel of each row is found by measuring which order of rows fits the cameras (docs/reference/exporters.md).

    Args:
        path: The ``.ply``, or a folder that has it.
        *more: Other scenes of the same place, which are joined with the first, in its frame
            (docs/guide/after-a-model.md).
        cameras: Camera file or folder, or "none". If None, cameras are searched beside the ``.ply``, with a warning if
            they do not fit.
        images: Folder of images, an ``.npz`` that holds images, or "none". If None, images are searched as cameras are.
        masks: Folder of images with the names of the photos, dark where a photo does not count, or "none". If None, the
            masks that ``transforms.json`` names are used, or the folder ``masks`` beside the photos, and the photos'
            transparency. Greys between dark and white weigh a pixel in a fit.
        protect: Folder of images with the names of the photos, white where a text or a face has to stay sharp; see
            :attr:`Scene.importance`.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_gaussians`.
        **hints: ``exporter``, ``quats``, ``scales``, ``colors``, ``order``, ``scene_scale``, ``max_side``,
            see :class:`gsmerge.settings.reading.ReadHints`.

    Returns:
        The scene; its ``pixels`` are None if the pixels of the rows are unknown.

    Raises:
        SceneError: If a file is missing or damaged, or if the Gaussians do not belong to the views of named cameras.
        ValueError: If an argument has a value that is not possible.

    Example:
        >>> scene = gsmerge.read_scene("demo/scene.ply", cameras="demo/transforms.json")
        >>> len(scene), scene.num_gaussians
        (5, 7680)
    """
    load = load_scene(
        path, *more, cameras=cameras, images=images, masks=masks, protect=protect, opacity=opacity, **hints
    )
    for doubt in load.doubts:
        warnings.warn(doubt, DoubtWarning, stacklevel=3)  # the caller: above this function and its decorator
    return replace(load.scene, notes=load.notes)


def load_scene(
    path: StrPath,
    *more: StrPath,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
    protect: StrPath | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Loaded:
    """Read a scene as :func:`read_scene` does, and return it with all facts about its files.

    Args and errors are those of :func:`read_scene`. No warning is given; doubts are among the ``notes``.

    Returns:
        The scene as ``scene``, the ``notes``, and ``candidates``: which cameras, photos and masks may belong to the
        scene, whether they are used, and why.

    Example:
        >>> for choice in gsmerge.load_scene("demo").candidates:
        ...     print(choice.kind, choice.path, choice.chosen)
        cameras transforms.json True
        photos images True
    """
    read_hints = make_hints(hints)
    named = {"cameras": cameras, "images": images, "masks": masks, "protect": protect}
    first, *others = (find_scene_files(scene_path, **named) for scene_path in (path, *more))
    return read_files(replace(first, more=tuple(others)), opacity=opacity, hints=read_hints)


def read_files(files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS) -> Loaded:
    """Read a scene as :func:`load_scene` does, from the files that :func:`find_scene_files` found."""
    with use_threads():
        loads = [
            finish(find_views(read_gaussian_file(scene_files, opacity=opacity, hints=hints), scene_files, hints))
            for scene_files in (replace(files, more=()), *files.more)
        ]
    if len(loads) == 1:
        return loads[0]
    # several scenes of the same place become one scene, which has the notes of all scenes
    from gsmerge.reading.alignment.registration.join import join_scenes

    joined = join_scenes([load.scene for load in loads], [load.files.ply for load in loads])
    scene = joined.scene
    used = [loads[i] for i in joined.used]
    notes = list[str]()
    choices = list[Choice]()
    for name, load in zip(joined.names, loads, strict=True):
        notes += name_notes(name, load.notes)
        choices += [replace(choice, path=f"{name}: {choice.path}") for choice in load.candidates]
    return replace(
        used[0],
        scene=scene,
        info=replace(used[0].info, **{name: sum(getattr(load.info, name) for load in used) for name in SUMMED_FACTS}),
        files=files,
        exporters=tuple(dict.fromkeys(exporter for load in used for exporter in load.exporters)),
        notes=(*notes, *joined.notes),
        alignment=check_pixels(scene),
        moves=[move for load in used for move in load.moves],
        joined=joined.facts,
        candidates=tuple(choices),
    )


def read_gaussian_file(files: SceneFiles, *, opacity: OpacityChoice, hints: ReadHints) -> GaussianFile:
    """Read the Gaussians of a scene's files.

    If the hints name an exporter that writes logits, opacities are read as logits, unless ``opacity`` says otherwise.
    """
    exporter = find_exporter(hints.exporter)
    # Raw opacities are not assumed for an exporter that writes them, since some of its versions write logits
    if exporter is not None and exporter.opacity == "logit" and opacity == "auto" and PLY.names(files.ply):
        opacity = "logit"
    encodings: dict[str, Any] = {"opacity": opacity, "scales": hints.scales, "colors": hints.colors}
    return read_parts(files.parts, **encodings) if files.parts else read_gaussians(files.ply, **encodings)


def find_views(
    ply: GaussianFile,
    files: SceneFiles,
    hints: ReadHints = NO_HINTS,
    *,
    photos: bool = True,
    keeps_cameras: bool = False,
) -> Loaded | SceneError:
    """Find the cameras and photos of Gaussians, and the pixel of every row if rows have pixels; or say why none fit.

    Both the scene and the error have the ``candidates``, with the reason why each was chosen or left out.
    Candidates for the cameras are examined in order, as long as they are needed, and one is chosen by the evidence.
    Cameras and photos that were found, but do not belong to the scene, are left out with a note. With
    ``keeps_cameras``, cameras are not estimated in place of files. If ``photos`` is False, no photos are searched.
    """
    candidates = list_candidates(files, keeps_cameras=keeps_cameras)
    tried = list[Evidence]()
    for candidate in candidates:
        views = parse_views(ply, candidate, photos=photos) if is_needed(candidate, tried) else None
        if views is not None:
            tried.append(release_spare(examine(ply, views, hints), tried))
    chosen = choose(tried)
    choices = give_reasons(candidates, tried, chosen)
    if chosen is None or chosen.load is None:
        # a hint on the order of rows that have none explains more than cameras that were found
        refused = None if "cameras" in files.named else attempt(check_hints, ply, hints)
        error = refused or explain_refusal(tried)
        error.candidates = choices
        return error
    # the first file needs no note, unless it was confirmed against others
    is_usual = chosen.files.cameras == files.cameras and not certainly_fits(chosen)
    on_choice = [] if is_usual else files.describe_choice(chosen.files.cameras)
    notes = (*on_choice, *chosen.notes)
    return replace(chosen.load, notes=notes, photos_explain=chosen.photos_explain, candidates=choices)


def finish(found: Loaded | SceneError) -> Loaded:
    """Return the scene that was found, with confirmed colours, larger photos and masks; raise SceneError if none was.

    Also raises SceneError for masks that cannot be used, see :func:`add_larger_and_masks`.
    """
    if isinstance(found, SceneError):
        raise found
    return add_larger_and_masks(confirm_colors(found))


def move_cameras_to_scene(ply: GaussianFile, files: SceneFiles, *, hints: ReadHints, photos: bool) -> Loaded:
    """Read a scene with its cameras moved into the frame of the Gaussians, if pixels or colours show that frame.

    If nothing shows that frame, the cameras stay as stored in their file. If ``photos`` is False, no photos are needed.
    If ``photos`` is True, named photos that cannot be read raise SceneError. Named cameras without a size raise
    SceneError, too.
    """
    # Errors of these attempts are lost, as the last call finds them again, or a way without the files
    for with_photos in dict.fromkeys((True, photos)):  # photos help to find the frame even if they are not needed
        moved = attempt(finish, find_views(ply, files, hints, photos=with_photos, keeps_cameras=True))
        if not isinstance(moved, SceneError):
            return moved
    as_stored = attempt(_keep_cameras, ply, files, hints, photos=photos)
    if isinstance(as_stored, Loaded):
        return as_stored
    return finish(find_views(ply, files, hints, photos=photos))  # this leaves out files that were not named


def _keep_cameras(ply: GaussianFile, files: SceneFiles, hints: ReadHints, *, photos: bool) -> Loaded | None:
    """Read a scene with its cameras as stored in their file; None if cameras that nobody named see no Gaussians."""
    camera_file = read_scene_cameras(ply, files)
    if camera_file is None:
        return None
    pictures = read_stored_photos(files, camera_file) if photos else ()
    cameras = to_cameras(camera_file, photo_size(pictures))
    if "cameras" not in files.named and not check_cameras(ply.gaussians, ply.valid, cameras, NO_IMAGES).ok:
        return None
    doubt = Doubt("the cameras do not fit the Gaussians; they stay as stored in their file")
    as_stored = AlignmentResult(None, cameras, as_floats(pictures), camera_file)
    return replace(make_scene(ply, Placed(files, as_stored, (doubt,)), hints), cameras=None)
