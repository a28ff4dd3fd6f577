"""Write and read the file of a state, which has either results and views, or Feature Gaussians of ``recipe=paper``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import count_words
from gsmerge.frozen import asdict, dataclass, fields, replace
from gsmerge.io.cameras.camera_file import MAX_NUMBER, check_camera, check_size
from gsmerge.io.formats.gsm import (
    FEATURES,
    NUM_HIGHER,
    SCENE,
    GsmFile,
    read_gsm,
    read_header,
    stored_cameras,
    stored_names,
    write_gsm,
    write_scene,
)
from gsmerge.jobs.states.features import FeatureState, ViewSamples
from gsmerge.method.geometry.frame import Frame
from gsmerge.method.networks.options import CORRECTED, GROUP_COLUMNS
from gsmerge.reading.checkpoint import build_networks
from gsmerge.reading.read_scene import load_scene
from gsmerge.types import FeatureGaussians, Gaussians, Scene, StrPath

FEATURE_COLUMNS = tuple(f.name for f in fields(FeatureGaussians) if f.name not in ("starts", "members", "views"))
_MAX_MEMBERS = (1 << 40) - 1  # most Gaussians of a group; a larger number is damaged


@dataclass(frozen=True, eq=False)
class State:
    """All batches of views so far, as a scene of results with views, or as Feature Gaussians."""

    about: Mapping[str, Any]  # facts in plain JSON types; `batches` has the figures of each batch
    scene: Scene | None = None  # None in a state of Feature Gaussians
    features: FeatureState | None = None  # None in a state of results

    def __repr__(self) -> str:
        return f"State({len(self):,} Gaussians of {count_words(len(self.about['batches']), 'batch')})"

    def __len__(self) -> int:
        return len(self.scene.gaussians) if self.scene is not None else len(self.features or ())


def save_state(path: StrPath, state: State, *, overwrite: bool = False, mode: int = 0o666) -> None:
    """Write a state to a file, completely or not at all; raise SceneError if the file exists or cannot be written.

    ``mode`` has the most access rights that a new file may have; see :func:`gsmerge.io.atomic.common_mode`.
    """
    if state.scene is not None:
        write_scene(path, state.scene, state.about, overwrite=overwrite, mode=mode)
        return
    features = state.features
    assert features is not None
    arrays: dict[str, np.ndarray] = {f"merged.{name}": getattr(features.merged, name) for name in FEATURE_COLUMNS}
    arrays |= {f"refined.{name}": getattr(features.refined, name) for name in CORRECTED}
    arrays |= {name: getattr(features, name) for name in ("views", "num_members", "saliency", "group")}
    arrays |= {f"samples.{name}": column for name, column in vars(features.samples).items()}
    arrays |= {f"networks.{name}": array for name, array in features.networks.arrays.items()}
    cameras = features.cameras
    frame = features.frame
    arrays |= {"viewmats": cameras.viewmats, "Ks": cameras.Ks, "merged.views": features.merged.views}
    arrays["origin"] = frame.origin
    header = {"kind": FEATURES, "width": cameras.width, "height": cameras.height, "unit": frame.unit}
    header["names"] = list(features.names)
    header |= {"networks": asdict(features.networks.options), "checkpoint": features.checkpoint}
    header |= {"about": dict(state.about)}
    write_gsm(path, header, arrays, overwrite=overwrite, mode=mode)


def load_state(path: StrPath) -> State:
    """Read a state from a file. No code in the file is executed.

    Raises SceneError if the file is missing or damaged, has another format or version, lacks an array, or has numbers
    out of range.
    """
    file = read_gsm(path)
    about = file.header["about"]
    batches = about.get("batches")
    if not isinstance(batches, list) or not all(isinstance(batch, dict) for batch in batches):
        raise file.error("about: expected a list of batches in the header, found none")
    if file.header["kind"] == FEATURES:
        return State(about, features=_read_features(file))
    scene = load_scene(path).scene
    if len(scene.gaussians) == len(file.arrays["means"]):  # take the stored numbers, since load_scene rounds scales
        scene = replace(scene, gaussians=Gaussians(*(file.arrays[f.name] for f in fields(Gaussians))))
    return State(about, scene)


def holds_features(path: Path) -> bool:
    """Return whether a ``.gsm`` holds Feature Gaussians and not results, or raise SceneError if it is unreadable."""
    return bool(read_header(path)["kind"] != SCENE)


def _read_features(file: GsmFile) -> FeatureState:
    """Read Feature Gaussians, and check type, shape and range of every array."""
    prefix = "networks."
    options = file.header.get("networks")
    if not isinstance(options, dict):
        raise file.error(f"expected networks in the header, found {options!r:.40}")
    stored_networks = {name.removeprefix(prefix): a for name, a in file.arrays.items() if name.startswith(prefix)}
    networks = build_networks(file.path, options, stored_networks)
    unit = file.header.get("unit")
    if not isinstance(unit, float) or not 0 < unit < MAX_NUMBER:
        raise file.error(f"unit: expected a length above 0 and below {MAX_NUMBER:g}, found {unit!r:.40}")
    cameras = stored_cameras(file)
    for view, (viewmat, K) in enumerate(zip(cameras.viewmats, cameras.Ks, strict=True)):
        check_camera(file.path, str(view), viewmat, K)
        check_size(file.path, str(view), K, (cameras.width, cameras.height))
    g = len(file.array("views", np.int64, None))
    num_views = len(cameras)
    num_higher = file.array("merged.shN", np.float32, g, None, 3).shape[1]
    if num_higher not in NUM_HIGHER:
        raise file.error(f"merged.shN: expected {NUM_HIGHER} harmonics, found {num_higher}")
    shapes: dict[str, tuple[int, ...]] = {  # of the columns that have more than one number per group
        "means": (3,), "covars": (3, 3), "sh0": (1, 3), "shN": (num_higher, 3), "latents": (networks.options.latent,),
    }  # fmt: skip
    columns = {name: _read_bounded_array(file, f"merged.{name}", g, *shapes.get(name, ())) for name in FEATURE_COLUMNS}
    merged = FeatureGaussians(
        **columns,
        views=_read_whole_numbers(file, "merged.views", g, -1, num_views),
        starts=np.zeros(g + 1, np.int64),  # the file stores no members
        members=np.zeros(0, np.int32),
    )
    corrected = {name: _read_bounded_array(file, f"refined.{name}", g, *shapes.get(name, ())) for name in CORRECTED}
    grid = file.array("samples.opacities", np.float32, num_views, None, None).shape  # views, height and width
    if 0 in grid[1:]:
        raise file.error("samples.opacities: expected pixels of every view, found none")
    sample_shapes = {"means": (3,), "opacities": (), "sh0": (3,)}
    samples = [_read_bounded_array(file, f"samples.{name}", *grid, *shape) for name, shape in sample_shapes.items()]
    return FeatureState(
        merged=merged,
        refined=replace(merged, **corrected),
        samples=ViewSamples(*samples),
        views=_read_whole_numbers(file, "views", g, 0, num_views),
        num_members=_read_whole_numbers(file, "num_members", g, 1, _MAX_MEMBERS + 1),
        saliency=file.finite("saliency", np.float64, g),
        group=_read_bounded_array(file, "group", g, GROUP_COLUMNS),
        cameras=cameras,
        frame=Frame(file.finite("origin", np.float64, 3), unit),
        networks=networks,
        checkpoint=str(file.header.get("checkpoint")),
        names=stored_names(file, num_views),
    )


def _read_bounded_array(file: GsmFile, name: str, *shape: int) -> np.ndarray:
    """Return a float32 array of a file; raise SceneError for numbers so large that sums overflow."""
    array = file.array(name, np.float32, *shape)
    largest = 1e37  # largest absolute value; float32 ends at 3e38
    if not (np.abs(array).max(initial=0) <= largest):  # NaN fails too
        raise file.error(f"{name}: expected finite numbers up to {largest:g}, found others")
    return array


def _read_whole_numbers(file: GsmFile, name: str, count: int, start: int, end: int) -> np.ndarray:
    """Return whole numbers ``[count]`` of a file; raise SceneError unless all are from ``start`` to ``end - 1``."""
    array = file.array(name, np.int64, count)
    if count and not start <= int(array.min()) <= int(array.max()) < end:
        raise file.error(f"{name}: expected numbers from {start} to {end - 1}, found others")
    return array
