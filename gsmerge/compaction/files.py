"""Read the scene of a run from its files."""

from __future__ import annotations

from dataclasses import replace

from gsmerge.compaction.outputs import Outputs
from gsmerge.errors import SceneError, split_notes
from gsmerge.io.formats.columns import list_names
from gsmerge.io.formats.ply import is_from_gsmerge
from gsmerge.io.formats.rows import RESULT_COMMENT
from gsmerge.reading.content_hash import list_changed, read_stats
from gsmerge.reading.exporters import NO_HINTS, ReadHints
from gsmerge.reading.read_scene import Loaded, load_files
from gsmerge.reading.scene_files import SceneFiles, result_cameras
from gsmerge.runtime.documents import file_sha256
from gsmerge.runtime.memory import release_memory
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.reading import OpacityChoice
from gsmerge.types import Scene


def with_output_name(settings: CompactOptions, outputs: Outputs) -> CompactOptions:
    """Return the settings with the name of the output file, because a budget may count the bytes of this file."""
    return replace(settings, budget=replace(settings.budget, output=outputs.result.name))


def list_first_layers(scene: Scene) -> list[int]:
    """Return the views, but if several have the same name and camera, and so are layers of one view, only the first."""
    cameras = zip(scene.names, scene.cameras.viewmats, scene.cameras.Ks, strict=True)
    keys = [(name, viewmat.tobytes(), K.tobytes()) for name, viewmat, K in cameras]
    return [view for view, key in enumerate(keys) if key not in keys[:view]]


def read_input(
    files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS, hashed: bool = False
) -> Loaded:
    """Read a scene from its files, with notes on missing or unusual content.

    If ``hashed``, the files of Gaussians are also hashed. Raises SceneError if the scene cannot be read, or if one of
    its files changes while it is read.
    """
    stats = read_stats(files)
    loaded = load_files(files, opacity=opacity, hints=hints)
    # The scene already has the photos that were inside the camera file, so the copy in ``loaded`` is freed
    cameras = None if loaded.cameras is None else replace(loaded.cameras, images=())
    sha256 = file_sha256(*files.all_plys) if hashed else None
    if changed := list_changed(stats):
        raise SceneError(changed[0], "changed while it was read", "run this again when the file is complete")
    release_memory()
    return replace(loaded, cameras=cameras, stats=stats, sha256=sha256, notes=(*loaded.notes, *_compact_notes(loaded)))


def _compact_notes(loaded: Loaded) -> list[str]:
    """Return notes on columns that the result will lack, and on a scene that is a result already.

    A file of gsmerge is recognised by its header or, in formats without one, by the cameras beside it. A file of
    gsmerge is a result if its header says so, or if it has at most one Gaussian for every two pixels of its views.
    """
    scene, comments, notes = loaded.scene, loaded.info.comments, list[str]()
    told = {name for note in split_notes(loaded.info.adapted, "columns")[0] for name in note.names}
    lost = [name for name in loaded.info.extra_columns if name not in told]
    if lost:
        notes.append(f"merged Gaussians do not have the columns {list_names(lost)}; gsmerge convert copies them")
    pixels = len(scene) * scene.cameras.height * scene.cameras.width
    is_own = is_from_gsmerge(comments) or result_cameras(loaded.files.ply) is not None
    is_small = is_own and scene.num_gaussians <= pixels / 2
    if is_small or RESULT_COMMENT in comments:
        count = f"{scene.num_gaussians:,} Gaussians for {pixels:,} pixels" if pixels else "no Gaussian per pixel"
        remedy = "start from the original for more detail"
        notes.append(f"the scene is compact already ({count}, written by gsmerge): {remedy}")
    return notes
