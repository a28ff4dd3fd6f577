"""Join scenes of one place into one scene, in the frame of the first scene that is joined."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import Doubt, SceneError, count_words
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.transforms import Similarity, rotmat_to_quat
from gsmerge.method.kernels.elementary import arccos
from gsmerge.reading.alignment.registration.register import register
from gsmerge.types import Cameras, Gaussians, LargePhotos, Pixels, Scene


@dataclass(frozen=True)
class JoinedScene:
    """Several scenes joined into one, in the frame of the first joined scene."""

    scene: Scene
    used: tuple[int, ...]  # numbers of the input scenes that are joined
    names: tuple[str, ...]  # names of all input scenes, for messages
    notes: tuple[str, ...]  # notes for the user, one sentence each
    # For each input scene its path, and whether it was joined. A joined scene also has the number of keypoints by which
    # it was registered, the angle of its rotation in degrees, its scale, and the shift of its origin
    facts: tuple[dict[str, Any], ...]


def join_scenes(scenes: Sequence[Scene], paths: Sequence[Path]) -> JoinedScene:
    """Join scenes of one place, whose frames and scales differ, into one scene.

    ``paths`` are the files of the scenes, for messages. Raises SceneError if a scene has no pixels, if views or
    harmonics differ in size, or if no two scenes show the same surfaces.
    """
    _check_joinable(scenes, paths)
    registration = register(scenes)
    with_folder = len({path.name for path in paths}) < len(paths)
    names = [os.path.join(path.parent.name, path.name) if with_folder else path.name for path in paths]
    used = [i for i, similarity in enumerate(registration.similarities) if similarity is not None]
    if len(used) < 2:
        problem = f"expected files that show one place, found no two of {len(paths)}"
        remedy = "give photos that overlap by half, name their folder with --images, or compact each file by itself"
        raise SceneError(paths[0], f"{problem} whose photos share enough of it", remedy)
    moved = [move_scene(scenes[i], move) for i in used if (move := registration.similarities[i]) is not None]
    least, most = (extreme(registration.matches[i] for i in used) for extreme in (min, max))
    counts = f"{least}" if least == most else f"{least} to {most}"
    joined = f"{len(used)} of {len(scenes)} files are joined in the frame of {names[used[0]]}"
    left_out = "is left out: its photo shares too few keypoints with the others"
    notes = [
        f"{joined}, by {counts} keypoints each",
        *(Doubt(f"{name} {left_out}") for i, name in enumerate(names) if i not in used),
    ]
    if len({scene.images is None for scene in moved}) > 1:
        notes.append(Doubt("some files have no photos, so none are used; name the folder of all with --images"))
    facts = []  # see JoinedScene
    for path, similarity, matches in zip(paths, registration.similarities, registration.matches, strict=True):
        entry: dict[str, Any] = {"path": str(path), "joined": similarity is not None}
        if similarity is not None:
            half_cosine = np.abs(rotmat_to_quat(similarity.rotation[None])[0, :1]).clip(0, 1)
            degrees = round(float(np.degrees(2 * arccos(half_cosine))[0]), 4)
            entry |= {"matches": matches, "degrees": degrees}
            entry |= {"scale": similarity.scale, "shift": similarity.shift.tolist()}
        facts.append(entry)
    return JoinedScene(concat_scenes(moved), tuple(used), tuple(names), tuple(notes), tuple(facts))


def _check_joinable(scenes: Sequence[Scene], paths: Sequence[Path]) -> None:
    """Raise SceneError if a scene has no pixels, or differs from the first scene in size or degree of harmonics."""
    size = scenes[0].cameras.width, scenes[0].cameras.height
    degree = scenes[0].gaussians.sh_degree
    for scene, path in zip(scenes, paths, strict=True):
        scene_size = scene.cameras.width, scene.cameras.height
        sh_degree = scene.gaussians.sh_degree
        if not scene.has_own_pixels:
            actual = (
                count_words(len(scene), "camera", "and Gaussians that are no pixels") if len(scene) else "no cameras"
            )
            problem = f"expected cameras and one Gaussian for each of their pixels, as scenes to join, found {actual}"
            raise SceneError(path, problem, "compact it by itself")
        if scene_size != size:
            expected = f"{size[0]} x {size[1]} as in {paths[0].name}"
            actual = f"{scene_size[0]} x {scene_size[1]}"
            raise SceneError(path, f"expected views of {expected}, found {actual}", "export all at one size")
        if sh_degree != degree:
            problem = f"expected harmonics of degree {degree} as in {paths[0].name}, found {sh_degree}"
            raise SceneError(path, problem, "export all with one degree")


def move_scene(scene: Scene, similarity: Similarity) -> Scene:
    """Return a scene with its Gaussians and cameras moved by a similarity, and with the same photos."""
    if similarity.scale == 1 and np.array_equal(similarity.rotation, np.eye(3)) and not similarity.shift.any():
        return scene
    gaussians = similarity.move_gaussians(scene.gaussians)
    cameras = similarity.move_cameras(scene.cameras)
    return replace(scene, gaussians=gaussians, cameras=cameras)


def concat_scenes(scenes: Sequence[Scene], photos: np.ndarray | None = None) -> Scene:
    """Concatenate the views of scenes of one size and frame; the result has pixels if all scenes have pixels.

    ``photos [v,h,w,3]`` are the photos of all views, if they are in one array already. Without ``photos``, the result
    has photos if all scenes have photos.
    """
    cameras = Cameras(
        np.concatenate([scene.cameras.viewmats for scene in scenes]),
        np.concatenate([scene.cameras.Ks for scene in scenes]),
        scenes[0].cameras.width,
        scenes[0].cameras.height,
        scenes[0].cameras.antialiased,
    )
    images = [scene.images for scene in scenes if scene.images is not None]
    if photos is None and len(images) == len(scenes):
        photos = np.concatenate(images)
    rows = [(len(scene.gaussians),) for scene in scenes]
    grids = [(len(scene), cameras.height, cameras.width) for scene in scenes]
    return Scene(
        gaussians=Gaussians.concat([scene.gaussians for scene in scenes]),
        cameras=cameras,
        images=photos,
        pixels=_concat_pixels(scenes),
        names=tuple(name for scene in scenes for name in scene.names),
        filled=concat_values([scene.filled for scene in scenes], rows, usual=False),
        large_photos=_concat_large([scene.large_photos for scene in scenes]),
        masks=None if photos is None else concat_values([scene.masks for scene in scenes], grids, usual=True),
        importance=concat_values([scene.importance for scene in scenes], grids, usual=np.float32(1)),
        region=scenes[0].region,
    )


def _concat_pixels(scenes: Sequence[Scene]) -> Pixels | None:
    """Concatenate the pixels of scenes; None if the views of any scene share Gaussians."""
    homes = list[np.ndarray]()
    fronts = list[np.ndarray]()
    num_rows = 0
    num_views = 0
    for scene in scenes:
        if not scene.has_own_pixels:
            return None
        pixels = scene.get_pixels()
        homes.append(np.where(pixels.homes >= 0, pixels.homes + num_views * scene.pixels_per_view, -1))
        fronts.append(np.where(pixels.shown, pixels.fronts + np.int32(num_rows), np.int32(-1)))
        num_rows = num_rows + len(scene.gaussians)
        num_views = num_views + len(scene)
    return Pixels(np.concatenate(homes), np.concatenate(fronts), own=True)


def concat_values(
    values: Sequence[np.ndarray | None], shapes: Sequence[tuple[int, ...]], *, usual: bool | np.float32
) -> np.ndarray | None:
    """Concatenate values of scenes; a scene without values gets ``usual`` in its shape. None if no scene has values."""
    if all(scene_values is None for scene_values in values):
        return None
    pairs = zip(values, shapes, strict=True)
    return np.concatenate([np.full(shape, usual) if array is None else array for array, shape in pairs])


def _concat_large(photos: Sequence[LargePhotos | None]) -> LargePhotos | None:
    """Concatenate the large photos of scenes; None if a scene has no large photos, or if sizes differ."""
    sources = [source for source in photos if source is not None]
    if len(sources) < len(photos) or len({(source.width, source.height) for source in sources}) > 1:
        return None
    source_views = [(source, source_view) for source in sources for source_view in source.ids]

    def read(view: int) -> np.ndarray:
        """Read the large photo of a view as its scene reads it."""
        source, source_view = source_views[view]
        return source.read(source_view)

    Ks = np.concatenate([source.Ks for source in sources])
    return LargePhotos(Ks, sources[0].width, sources[0].height, tuple(range(len(source_views))), read)
