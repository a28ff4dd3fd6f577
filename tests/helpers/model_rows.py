"""Programs keep rows of made scenes: of which pixels, in which order, world and encoding."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from exports import Smooth, export_rows, save_export, smooth_scene, turned, with_surface_rotations
from tiny_scene import save_json, write_images, write_transforms

from gsmerge.method.geometry.transforms import normalize
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.matrices import matmul
from gsmerge.types import Gaussians, Scene

HALF = np.sqrt(0.5)
# pixelSplat's: the first camera's z becomes up, and all is turned by -45 degrees about it
UPRIGHT = matmul(
    np.array([[HALF, HALF, 0], [-HALF, HALF, 0], [0, 0, 1]]), np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
)
NAMES = tuple(f"{i:06d}.png" for i in (4, 17, 30))


@dataclass(frozen=True)
class World:
    """A world as it is stored: ``scale * turn @ x + shift``."""

    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def move(self, c2w: np.ndarray) -> np.ndarray:
        """Return the poses in it."""
        out = c2w.copy()
        out[:, :3, :3] = matmul(self.turn, c2w[:, :3, :3])
        out[:, :3, 3] = matmul(self.scale * c2w[:, :3, 3], self.turn.T) + self.shift
        return out


@dataclass(frozen=True)
class Export:
    """What a model left, and the truth about it."""

    path: Path  # what the user names
    scene: Smooth  # its views as the model saw them
    rows: np.ndarray  # of the file
    world: World  # in which the rows are
    # place of each row in a scene of one Gaussian per pixel, layers as views of their own; None where there is none
    pixels: np.ndarray | None
    opacities: np.ndarray
    options: dict[str, Path] = field(default_factory=dict)  # the cameras and photos that the user names
    quats: np.ndarray | None = None  # ``[n,4]`` true rotations of the rows; None where they cannot be known


@dataclass(frozen=True)
class Saver:
    """Describe how a program turns the pixels of its views into rows."""

    place: str  # of the .ply in its folder
    order: str = "view-major"
    trim: int = 0  # pixels at each border
    layers: int = 1  # Gaussians per pixel
    frame: str = "same"
    raw: bool = False  # opacities as they are in place of logits
    rest: int = 0
    normals: str = "f4"
    least: float = 0.0  # opacity of the rows that it keeps


@cache
def made(width: int = 48, height: int = 36, views: int = 3) -> Smooth:
    """Make views of square pixels and a middle principal point, discs in the surface, one in nine faint."""
    focal = 1.1 * max(width, height)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return take_views(with_surface_rotations(replace(smooth_scene(width, height, K), names=NAMES)), views)


def take_views(scene: Smooth, count: int) -> Smooth:
    """Return the first views."""
    n = count * scene.width * scene.height
    parts = {name: getattr(scene, name)[:count] for name in ("c2w", "images", "names", "depths")}
    return replace(scene, gaussians=scene.gaussians[:n], **parts)


def with_faint(scene: Smooth) -> Smooth:
    """Return the scene with every ninth Gaussian nearly transparent."""
    opacities = scene.gaussians.opacities.copy()
    opacities[::9] = 0.003
    return replace(scene, gaussians=replace(scene.gaussians, opacities=opacities))


def with_layers(scene: Smooth, layers: int) -> Smooth:
    """Return the scene with several Gaussians per pixel, one behind the other, each layer after its view's first."""
    parts, size = [], scene.width * scene.height
    for view, pose in enumerate(scene.c2w):
        g = scene.gaussians[view * size : (view + 1) * size]
        for layer in range(layers):
            means = pose[:3, 3] + (1 + 0.06 * layer) * (g.means - pose[:3, 3])
            opacities = g.opacities / (1 if layers == 1 else 1.5 + layer)
            parts.append(replace(g, means=means.astype(np.float32), opacities=opacities.astype(np.float32)))
    return replace(scene, gaussians=Gaussians.concat(parts))


# What is beside the Gaussians


def as_photos(scene: Smooth, factor: float, border: int = 0) -> Smooth:
    """Return the cameras and photos at another size, as the user took them; ``border``: they show more left and right.

    The border is as wide as so many of the model's columns.
    """
    wide = [cv2.copyMakeBorder(image, 0, 0, border, border, cv2.BORDER_REFLECT) for image in scene.images]
    width, height = round(factor * (scene.width + 2 * border)), round(factor * scene.height)
    K = scene.K + np.array([[0, 0, border], [0, 0, 0], [0, 0, 0]])
    images = np.stack([cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC) for image in wide])
    return replace(scene, K=K * np.array([[factor], [factor], [1]]), width=width, height=height, images=images)


def data_set(folder: Path, scene: Smooth, *names: str) -> dict[str, Path]:
    """Write the user's own cameras and photos elsewhere, and return those of them that are named."""
    data = folder.parent / "data"
    write_images(data / "images", scene)
    write_transforms(data / "transforms.json", scene)
    paths = {"cameras": data / "transforms.json", "images": data / "images"}
    if "cameras" not in names:
        paths["cameras"].unlink()
    return {name: paths[name] for name in names}


def write_world_mirror(path: Path, scene: Smooth) -> None:
    """Write ``camera_params.json``."""
    document = {
        "num_cameras": len(scene.c2w),
        "extrinsics": [{"camera_id": i, "matrix": pose.tolist()} for i, pose in enumerate(scene.c2w)],
        "intrinsics": [{"camera_id": i, "matrix": scene.K.tolist()} for i in range(len(scene.c2w))],
    }
    save_json(path, document)


# Rows


def world_of(frame: str, scene: Smooth, means: np.ndarray) -> World:
    """Return the world that a program stores these means in."""
    pose = scene.c2w[len(scene.c2w) // 2 if frame == "middle" else 0]
    turn = pose[:3, :3].T
    if frame in ("first", "middle"):
        return World(turn)
    if frame == "camera":
        return World(turn, shift=matmul(-turn, pose[:3, 3]))
    if frame == "upright":
        median = np.median(means, 0)
        scale = 1 / np.quantile(np.abs(means - median), 0.95, axis=0).max()
        return World(matmul(UPRIGHT, turn), scale, matmul(matmul(-scale * UPRIGHT, turn), median))
    if frame == "scaled":
        return World(scale=1 / 1.7)
    return World()


def pixel_rows(saver: Saver, scene: Smooth, keep: np.ndarray | None = None) -> Export:
    """Make the rows of the pixels that a saver keeps; ``keep [v,h,w]`` drops more. The path is the .ply's place."""
    h, w, trim = scene.height, scene.width, saver.trim
    layered = with_layers(scene, saver.layers)
    shape = (len(scene.c2w), saver.layers, h, w)
    kept = np.zeros(shape, bool)
    kept[:, :, trim : h - trim, trim : w - trim] = True
    kept &= layered.gaussians.opacities.reshape(shape) >= saver.least
    kept &= True if keep is None else keep[:, None]
    axes = {"view-fastest": (2, 3, 1, 0), "layer-major": (0, 1, 2, 3)}.get(saver.order, (0, 2, 3, 1))
    pixels = np.arange(kept.size).reshape(shape).transpose(axes)[kept.transpose(axes)]
    if saver.order == "opacity":
        pixels = pixels[np.argsort(-layered.gaussians.opacities[pixels], kind="stable")]
    world = world_of(saver.frame, scene, layered.gaussians.means[pixels])
    return finish_rows(saver, layered, pixels, world, scene)


def finish_rows(saver: Saver, layered: Smooth, pixels: np.ndarray, world: World, scene: Smooth) -> Export:
    """Make the rows of some Gaussians in a world, as a saver encodes opacities."""
    rows = export_rows(layered, pixels, rest=saver.rest, normals=saver.normals)
    rows = turned(rows, world.turn, scale=world.scale, shift=world.shift)
    quats = np.stack([rows[f"rot_{i}"] for i in range(4)], 1)
    if saver.raw:
        rows["opacity"] = layered.gaussians.opacities[pixels]
    truth = {"opacities": layered.gaussians.opacities[pixels], "quats": quats}
    return Export(Path(saver.place), scene, rows, world, pixels, **truth)


def save_pixels(saver: Saver, scene: Smooth, folder: Path, keep: np.ndarray | None = None) -> Export:
    """Write the rows of a scene's pixels; the path is the folder."""
    return save(pixel_rows(saver, scene, keep), folder)


def save(export: Export, folder: Path) -> Export:
    """Write rows to their place in a folder."""
    place = folder / export.path
    save_export(place.parent, export.scene, export.rows, cameras=False, name=place.name)
    return replace(export, path=folder)


def merge_voxels(scene: Smooth, size: float) -> Gaussians:
    """Merge the Gaussians of each cell of a grid, in the order of the cells."""
    g = scene.gaussians
    _, cells = np.unique(np.floor(g.means / size).astype(int), axis=0, return_inverse=True)
    counts = np.bincount(cells.reshape(-1))

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.zeros((len(counts), *values.shape[1:]))
        np.add.at(sums, cells.reshape(-1), values)
        return (sums / counts.reshape(-1, *[1] * (values.ndim - 1))).astype(np.float32)

    merged = Gaussians(*(mean(values) for values in vars(g).values()))
    return replace(merged, quats=normalize(merged.quats))


def save_unordered(
    saver: Saver, scene: Smooth, gaussians: Gaussians, folder: Path, world: World | None = None
) -> Export:
    """Write Gaussians that belong to no pixels; the path is the folder. ``world`` None: that of the saver."""
    layered = replace(scene, gaussians=gaussians)
    world = world_of(saver.frame, scene, gaussians.means) if world is None else world
    export = finish_rows(saver, layered, np.arange(len(gaussians)), world, scene)
    return save(replace(export, pixels=None), folder)


def check_cameras(scene: Scene, export: Export) -> None:
    """Check that a scene has all views: their cameras in the frame of the file, and the photos that belong to them."""
    poses = export.world.move(export.scene.c2w)
    layers = len(scene) // len(poses)
    assert layers * len(poses) == len(scene)
    turns = matmul(scene.cameras.viewmats[::layers, :3, :3], poses[:, :3, :3])
    assert np.degrees(elementary.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))).max() < 0.5
    middle = np.median(np.stack([export.rows[name] for name in "xyz"], 1), 0)
    size = np.linalg.norm(poses[:, :3, 3] - middle, axis=1).max()
    assert np.abs(scene.cameras.centres[::layers] - poses[:, :3, 3]).max() < 0.01 * size
    for image, photo in zip(scene.images[::layers], export.scene.images, strict=True):
        expected = cv2.resize(photo, image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
        assert np.abs(image - expected / 255).mean() < 0.02


def check_pixels(scene: Scene, export: Export) -> None:
    """Check that a scene has every row of a file at its pixel, with its opacity and its rotation."""
    assert export.pixels is not None
    drawn = export.opacities >= 1 / 255
    assert scene.num_gaussians == int(drawn.sum())
    g = scene.gaussians[scene.pixels.fronts.reshape(-1)[export.pixels]]
    stored = np.stack([export.rows[name] for name in "xyz"], 1)
    at_home = drawn & np.isclose(g.means, stored, rtol=1e-4, atol=1e-6).all(1)
    assert at_home.sum() > 0.999 * drawn.sum()
    assert np.abs(g.opacities - export.opacities)[at_home].max() < 1e-4
    if export.quats is not None:
        assert np.median(np.abs((g.quats * export.quats).sum(1))[at_home]) > 0.999
