"""Take the input of a run: check a scene in memory, read one from a path, or from files that must not change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gsmerge.arrays import Array, as_array, check_numbers
from gsmerge.errors import SceneError, split_notes
from gsmerge.io.cameras.camera_file import check_camera
from gsmerge.io.formats.columns import list_names
from gsmerge.io.formats.ply import is_from_gsmerge
from gsmerge.io.formats.rows import RESULT_COMMENT
from gsmerge.reading.exporters import NO_HINTS, ReadHints
from gsmerge.reading.file_stats import list_changed, read_stats
from gsmerge.reading.read_scene import Loaded, load_scene, read_files
from gsmerge.reading.scene_files import SceneFiles, result_cameras
from gsmerge.runtime.documents import file_sha256
from gsmerge.runtime.memory import release_memory
from gsmerge.runtime.record import note
from gsmerge.settings.reading import OpacityChoice
from gsmerge.types import NO_CAMERAS, Gaussians, Scene, StrPath, make_scene

TOLERANCE = 1e-3  # opacities and images may lie outside [0, 1] by this much


def as_scene(scene: Scene | Gaussians | StrPath) -> Scene:
    """Check a scene and return it unchanged, or read it from a path; notes of reading go into the record of the run.

    Gaussians alone become a scene without views.
    """
    if isinstance(scene, Gaussians):
        scene = make_scene(scene, NO_CAMERAS)
    if isinstance(scene, Scene):
        check_scene(scene)
    else:
        load = load_scene(scene)
        scene = replace(load.scene, notes=load.notes)
    for text in scene.notes:
        note(text)
    return scene


def read_input(
    files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS, hashed: bool = False
) -> Loaded:
    """Read a scene from its files, with notes on missing or unusual content.

    If ``hashed``, the files of Gaussians are also hashed. Raises SceneError if the scene cannot be read, or if one of
    its files changes while it is read.
    """
    stats = read_stats(files)
    loaded = read_files(files, opacity=opacity, hints=hints)
    # The scene already has the photos that were inside the camera file, so the copy in ``loaded`` is freed
    cameras = None if loaded.cameras is None else replace(loaded.cameras, images=())
    plys = (ply for scene_files in (files, *files.more) for ply in scene_files.plys)
    sha256 = file_sha256(*plys) if hashed else None
    if changed := list_changed(stats):
        raise SceneError(changed[0], "changed while it was read", "run this again when the file is complete")
    release_memory()
    # columns that the result will lack
    scene = loaded.scene
    comments = loaded.info.comments
    notes = [*loaded.notes]
    told = {name for note in split_notes(loaded.info.adapted, "columns")[0] for name in note.names}
    lost = [name for name in loaded.info.extra_columns if name not in told]
    if lost:
        notes.append(f"merged Gaussians do not have the columns {list_names(lost)}; gsmerge convert copies them")
    # A scene that is a result already. A file of gsmerge is recognised by its header or, in formats without one, by the
    # cameras beside it. It is a result if its header says so, or if it has at most one Gaussian for every two pixels of
    # its views
    pixels = len(scene) * scene.cameras.height * scene.cameras.width
    is_own = is_from_gsmerge(comments) or result_cameras(loaded.files.ply) is not None
    is_small = is_own and scene.num_gaussians <= pixels / 2
    if is_small or RESULT_COMMENT in comments:
        count = f"{scene.num_gaussians:,} Gaussians for {pixels:,} pixels" if pixels else "no Gaussian per pixel"
        remedy = "start from the original for more detail"
        notes.append(f"the scene is compact already ({count}, written by gsmerge): {remedy}")
    return replace(loaded, cameras=cameras, stats=stats, sha256=sha256, notes=tuple(notes))


def check_scene(scene: Scene) -> None:
    """Raise SceneError if values have another convention than gsmerge's, as in scenes that callers may make."""
    gaussians = vars(scene.gaussians)
    cameras = scene.cameras
    arrays = {**gaussians, "viewmats": cameras.viewmats, "Ks": cameras.Ks, "images": scene.images}
    for name, values in arrays.items():
        if values is not None:
            check_numbers(name, values)
    check_values(gaussians)
    check_poses(as_array(cameras.viewmats), as_array(cameras.Ks))


def check_values(columns: Mapping[str, Array]) -> None:
    """Raise SceneError if scales are logarithms or opacities are logits. Rows that are not finite are ignored."""
    scales = as_array(columns["scales"])
    opacities = as_array(columns["opacities"])
    if len(scales) == 0 or (_lie_within(scales, 0, np.inf) and _lie_within(opacities, 0, 1)):
        return
    finite = np.isfinite(scales).all(1) & np.isfinite(opacities)
    if not finite.any():
        return
    scales = scales[finite]
    opacities = opacities[finite]
    negative = float((scales < 0).any(1).mean())
    if negative > 0:
        problem = f"expected standard deviations of at least 0, found negative ones in {100 * negative:.3g} % of rows"
        raise SceneError("scales", problem, "they look like log scales: pass scales.exp()")
    low = float(opacities.min())
    high = float(opacities.max())
    if low < -TOLERANCE or high > 1 + TOLERANCE:
        problem = f"expected opacities in [0, 1], found {low:.3g} to {high:.3g}"
        raise SceneError("opacities", problem, "they look like logits: pass torch.sigmoid(opacities)")


def _lie_within(values: np.ndarray, low: float, high: float) -> bool:
    """Return whether all values lie between two limits. NaN is ignored."""
    return bool(np.fmin.reduce(values, axis=None) >= low and np.fmax.reduce(values, axis=None) <= high)


def check_poses(viewmats: np.ndarray, Ks: np.ndarray) -> None:
    """Raise SceneError if poses ``[c,4,4]`` or intrinsics ``[c,3,3]`` are impossible, for example transposed."""
    for view, (pose, K) in enumerate(zip(viewmats, Ks, strict=True)):
        if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-3:
            problem = f"view {view}: expected 0 0 0 1 as the last row, found another"
            raise SceneError("viewmats", problem, "if they are transposed, pass viewmats.transpose(-1, -2)")
        check_camera("viewmats", str(view), pose, np.eye(3))
        check_camera("Ks", str(view), np.eye(4), K)
