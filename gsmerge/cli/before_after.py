"""Read a scene, its compact versions and held-out views, for the commands that compare or measure them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.cli.parameters import Reading, usage_errors
from gsmerge.errors import SceneError, UsageError
from gsmerge.frozen import dataclass, replace
from gsmerge.settings.evaluate import NETS, EvaluateOptions

if TYPE_CHECKING:
    from gsmerge.io import GaussianFile
    from gsmerge.reading.read_scene import Loaded
    from gsmerge.reading.scene_files import SceneFiles
    from gsmerge.types import Cameras, Gaussians, Scene, Views


def lpips_networks(
    choice: str | None, usual: Sequence[str] = EvaluateOptions().lpips
) -> tuple[tuple[str, ...], list[str]]:
    """Return the LPIPS networks to measure with, by ``--lpips``, and a note if there is none.

    By default these are the ``usual`` networks that are installed.
    """
    from gsmerge.scoring.lpips import INSTALL, installed_networks, lpips_available

    if choice is None:
        return installed_networks(usual)
    nets = {"both": NETS, "none": ()}.get(choice, (choice,))
    if not all(map(lpips_available, nets)):
        raise UsageError(f"--lpips: the weights are not installed: {INSTALL}; or pass --lpips none")
    return nets, []


@dataclass(frozen=True)
class BeforeAfter:
    """A scene and its compact versions, as commands compare them."""

    load: Loaded  # the scene as it was read
    scene: Scene  # the scene with the views to measure; gsmerge places views if the scene has none
    held_out: Views | None  # views that were not part of the input
    plys: dict[str, GaussianFile]  # the compact versions by name
    cameras: dict[str, Cameras]  # version -> cameras of the input views, if the version moved them
    notes: list[str]  # one sentence for each adaptation

    @property
    def title(self) -> str:
        """Name of the scene."""
        from gsmerge.reading.scene_files import scene_title

        return scene_title(self.load.files.ply)

    @property
    def gaussians(self) -> dict[str, Gaussians]:
        """Gaussians of the compact versions by name."""
        return {name: ply.gaussians for name, ply in self.plys.items()}


def read_before_after(
    files: SceneFiles, after: Sequence[Path], reading: Reading, *, loaded: Loaded | None = None,
    targets: Path | None = None, target_images: Path | None = None, views: int | None = None,
) -> BeforeAfter:  # fmt: skip
    """Read a scene, its compact versions, and the held-out views of ``--targets``.

    ``files`` are the files of the scene, which may be ``loaded`` already. If it has no views, some views are placed.
    """
    from gsmerge.io import read_gaussians
    from gsmerge.method.viewpoints.place_cameras import NO_VIEWS, PLACED_VIEWS, add_views
    from gsmerge.reading.read_scene import read_files
    from gsmerge.reading.scene_files import result_cameras
    from gsmerge.runtime.record import record_run

    if files.cameras is None and "cameras" not in files.named:  # a result may have cameras although its scene has none
        files = replace(files, cameras=next(filter(None, map(result_cameras, after)), None))
    load = loaded if loaded is not None and loaded.files == files else read_files(files, **reading._asdict())
    if targets is not None or views is not None:
        require_views(load)
    scene, held_out, target_notes = held_out_views(load, targets, target_images, views)
    with record_run() as record:
        scene = add_views(scene, shown=True, placed=NO_VIEWS if after else PLACED_VIEWS)
    notes = [*record.notes]
    plys = {name: read_gaussians(path) for name, path in zip(file_names(after), after, strict=True)}
    if plys and all(ply.info.count > load.info.count for ply in plys.values()):
        notes.append(
            f"{files.ply.name} has fewer Gaussians than the files it is compared with; perhaps BEFORE and AFTER are"
            " swapped"
        )
    cameras, camera_notes = own_cameras(after, scene)
    for name, ply in plys.items():  # files of different marks are each drawn their own way
        if ply.info.antialiased != scene.cameras.antialiased:
            cameras[name] = replace(cameras.get(name, scene.cameras), antialiased=ply.info.antialiased)
    return BeforeAfter(
        load, scene=scene, held_out=held_out, plys=plys, cameras=cameras,
        notes=[*load.notes, *target_notes, *notes, *camera_notes],
    )  # fmt: skip


def own_cameras(paths: Sequence[Path], scene: Scene) -> tuple[dict[str, Cameras], list[str]]:
    """Return, by name of a result whose fit moved the cameras, its cameras; also return notes.

    The cameras are read from the file of the result, or from the file of cameras beside it.
    """
    import numpy as np

    from gsmerge.io.cameras.camera_file import describe_moves, list_moves
    from gsmerge.io.cameras.read_cameras import read_cameras
    from gsmerge.method.geometry.frame import scene_depth
    from gsmerge.reading.scene_files import result_cameras

    cameras: dict[str, Cameras] = {}
    notes = list[str]()
    start = scene.cameras.viewmats
    tolerance = 1e-5  # difference, absolute and relative, that writing and reading a pose may cause
    for name, path in zip(file_names(paths), paths, strict=True):
        camera_path = result_cameras(path)
        camera_file = None
        if camera_path is not None and scene.is_shown:
            with suppress(SceneError):  # a damaged camera file does not prevent measuring
                camera_file = read_cameras(camera_path)
        if camera_file is None or camera_path is None or camera_file.names != scene.names:
            continue
        viewmats = camera_file.viewmats
        if np.allclose(viewmats, start, rtol=tolerance, atol=tolerance):
            continue
        cameras[name] = replace(scene.cameras, viewmats=viewmats)
        moves = describe_moves(list_moves(scene.names, start, viewmats, scene_depth(scene)))
        notes.append(
            f"{name}: its input views are drawn from the cameras in {camera_path.name}, which are moved by {moves}"
        )
    return cameras, notes


def require_views(load: Loaded) -> None:
    """Raise SceneError if a scene has no views."""
    if len(load.scene) == 0:
        problem = "expected cameras to measure from, found none beside the scene"
        remedy = "name them with --cameras, or leave out --targets and --views: views are placed then"
        raise SceneError(load.files.ply, problem, remedy)


def held_out_views(
    load: Loaded, targets: Path | None, target_images: Path | None, views: int | None
) -> tuple[Scene, Views | None, tuple[str, ...]]:
    """Return the scene with the number of ``views`` that ``--views`` states, the held-out views of ``targets``, and
    notes.

    With ``views``, only the held-out views between the chosen views are returned.
    """
    from gsmerge.method.geometry.views import even_views, midpoint_views, subset
    from gsmerge.reading.held_out import read_held_out

    if target_images is not None and targets is None:
        raise UsageError("--target-images: expected the cameras of these photos too; name them with --targets")
    held_out = None if targets is None else read_held_out(load, targets, target_images)
    notes = () if held_out is None else held_out.notes
    if views is None:
        return load.scene, held_out, notes
    with usage_errors():
        ids = even_views(len(load.scene), views)
    target_ids: Sequence[int] = ()
    if held_out is not None:
        if held_out.context_places is None:
            raise UsageError("--views: expected --targets to name the input views too, in the order of the trajectory")
        target_ids = midpoint_views([held_out.context_places[i] for i in ids], held_out.places)
        if not target_ids:
            raise UsageError(f"--views {views}: expected held-out views between the input views, found none")
    return subset(load.scene, ids), held_out and held_out[target_ids], notes


def file_names(paths: Sequence[Path]) -> list[str]:
    """Return a unique name of each file; UsageError for a repeated file.

    The names are the file names if all file names differ, otherwise the paths.
    """
    if len(set(paths)) < len(paths):
        raise UsageError(f"expected every result once, got {max(paths, key=paths.count)} twice")
    short = [path.name for path in paths]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]
