"""Some forty models and programs leave made scenes, written here from what their saving code does.

Each writer of ``MODELS`` takes a folder, and returns what a user would name, with the truth about it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from exports import depth_map_mask, save_export
from model_rows import (
    NAMES,
    Export,
    Saver,
    World,
    as_photos,
    data_set,
    finish_rows,
    made,
    merge_voxels,
    pixel_rows,
    save,
    save_pixels,
    save_unordered,
    with_faint,
    world_of,
    write_world_mirror,
)
from plyfile import PlyData
from sharp_files import write_elements
from tiny_scene import rotation, save_json, write_colmap_binary, write_images, write_inria, write_npz

from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.types import Gaussians


def dataset_model(
    saver: Saver, names: tuple[str, ...], size: tuple[int, int, int], folder: Path, *, faint: bool = False,
    factor: float = 1, border: int = 0, far: float = 1,
) -> Export:  # fmt: skip
    """Write what a model leaves that takes cameras from its data set; the user names some of that.

    ``far``: share of the depths that are near enough to be kept.
    """
    scene = with_faint(made(*size)) if faint else made(*size)
    keep = None if far == 1 else scene.depths < np.quantile(scene.depths, far)
    export = save_pixels(saver, scene, folder, keep)
    options = data_set(folder, as_photos(scene, factor, border), *names) if names else {}
    return replace(export, path=folder / saver.place, options=options)


# Depth Anything 3


def write_points_glb(path: Path) -> None:
    """Write a ``.glb`` of no Gaussians."""
    text = json.dumps({"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{}]}).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)


def depth_anything(formats: str, folder: Path, *, photos: int = 2) -> Export:
    """Write what the formats of ``export_format`` name, joined by ``-``; the photos are larger than the model's."""
    scene = made(48, 36)
    keep = np.stack([depth_map_mask(depth) for depth in scene.depths])
    nested = "npz" in formats  # whose cameras and depths are in another unit
    saver = Saver("gs_ply/0000.ply", frame="scaled" if nested else "same")
    export = save_pixels(saver, scene, folder, keep)
    larger = as_photos(scene, photos)
    if "npz" in formats:
        arrays = {"depth": scene.depths.astype(np.float32), "conf": np.ones_like(scene.depths)}
        name = "mini_npz" if "mini" in formats else "npz"
        image = {} if name == "mini_npz" else {"image": scene.images}
        write_npz(folder / f"exports/{name}/results.npz", scene, **{"image": None, **arrays, **image})
    if "colmap" in formats:
        write_colmap_binary(folder, larger)
        (folder / "points3D.bin").write_bytes(bytes(8))
    if "glb" in formats:
        write_points_glb(folder / "scene.glb")
        cv2.imwrite(str(folder / "scene.jpg"), scene.images[0])
        (folder / "gs_video").mkdir()
        (folder / "gs_video/0000_extend.mp4").touch()
    options = {} if formats.startswith(("npz", "glb")) else data_set(folder, larger, "images")
    return replace(export, options=options)


def lyra(folder: Path) -> Export:
    """Write Lyra 2's: Depth Anything 3's rows but for a border, of half the photos' size; cameras of its own."""
    scene = made(64, 48)
    keep = np.zeros((3, 48, 64), bool)
    keep[:, 1:-1, 2:-2] = True
    export = save_pixels(Saver("reconstructed_scene.ply"), scene, folder, keep)
    larger = as_photos(scene, 2)
    video = {"w2c_render": np.tile(np.eye(4), (9, 1, 1)), "intrinsics_render": np.tile(np.eye(3), (9, 1, 1))}
    Ks = np.tile(larger.K, (len(scene.c2w), 1, 1))
    np.savez(folder / "cameras.npz", **video, w2c_recon_sampled=scene.w2c, intrinsics_recon_sampled=Ks)
    return replace(export, options=data_set(folder, larger, "images"))


# Models with folders of their own


def depth_splat(folder: Path, *, cameras: bool = True, photos: bool = True) -> Export:
    """Write DepthSplat's: Gaussians and photos of a scene in folders by kind."""
    saver = Saver("gaussians/room.ply", "view-fastest", 8, frame="first")
    scene = replace(made(64, 48), names=tuple(f"input_{name}" for name in NAMES))
    export = save_pixels(saver, scene, folder)
    if photos:
        write_images(folder / "images/room/color", scene)
    return replace(export, options=data_set(folder, scene, "cameras") if cameras else {})


def spfsplat(folder: Path) -> Export:
    """Write SPFSplat's: photos under names of the scene beside the Gaussians, and its own drawings."""
    saver = Saver("re10k_room_gaussians.ply", "view-fastest", 8, frame="upright", raw=True)
    scene = replace(made(64, 64, 2), names=("re10k_room_input_0.png", "re10k_room_input_1.png"))
    export = save_pixels(saver, scene, folder)
    write_images(folder, scene)
    cv2.imwrite(str(folder / "re10k_room_angle_000_raw.png"), np.zeros((64, 64, 3), np.uint8))
    return export


def free_splat(folder: Path) -> Export:
    """Write FreeSplat's: of each further view, pixels that lie on the scene so far are fused with what they lie on."""
    scene = made()
    size = scene.width * scene.height
    g = scene.gaussians[:size]
    for view in range(1, 3):
        w2c, more = scene.w2c[view], scene.gaussians[view * size : (view + 1) * size]
        camera = matmul(g.means, w2c[:3, :3].T) + w2c[:3, 3]
        x, y = np.floor(matmul(camera, scene.K.T)[:, :2] / camera[:, 2:]).astype(int).T
        inside = (camera[:, 2] > 0) & (x >= 0) & (x < scene.width) & (y >= 0) & (y < scene.height)
        pixel = np.where(inside, y * scene.width + x, 0)
        near = np.abs(camera[:, 2] - scene.depths[view].reshape(-1)[pixel]) < 0.05 * camera[:, 2]
        fused = np.full(size, -1)
        fused[pixel[inside & near]] = np.flatnonzero(inside & near)
        new = np.flatnonzero(fused >= 0)
        old = fused[new]
        share = (g.opacities[old] / (g.opacities[old] + more.opacities[new]))[:, None]
        means = (share * g.means[old] + (1 - share) * more.means[new]).astype(np.float32)
        kept = np.setdiff1d(np.arange(len(g)), old)
        g = Gaussians.concat([g[kept], replace(g[old], means=means), more[fused < 0]])
    world = world_of("upright", scene, g.means)
    saver = Saver("gaussians/room.ply", raw=True)
    export = finish_rows(saver, replace(scene, gaussians=g), np.arange(len(g)), world, scene)
    options = data_set(folder, scene, "cameras", "images")
    return replace(save(export, folder), pixels=None, options=options)


def long_lrm(folder: Path, *, order: str = "view-major") -> Export:
    """Write Long-LRM's: in the mean pose of its views, which lie within +-1; the data set has the cameras."""
    scene = with_faint(made())
    mean = np.eye(4)
    forward, down = scene.c2w[:, :3, 2].mean(0), scene.c2w[:, :3, 1].mean(0)
    mean[:3, 2] = forward / np.linalg.norm(forward)
    down -= matmul(down, mean[:3, 2]) * mean[:3, 2]
    mean[:3, 1] = down / np.linalg.norm(down)
    mean[:3, 0], mean[:3, 3] = np.cross(mean[:3, 1], mean[:3, 2]), scene.c2w[:, :3, 3].mean(0)
    move = invert(mean)
    scale = 1 / np.abs(matmul(move, scene.c2w)[:, :3, 3]).max()
    saver = Saver("gaussians_001.ply", order, rest=45, normals="u1")
    if order == "opacity":  # the most opaque, and some of the others
        saver = replace(saver, least=float(np.quantile(scene.gaussians.opacities, 0.6)))
    pixels = pixel_rows(saver, scene).pixels
    assert pixels is not None
    export = finish_rows(saver, scene, pixels, World(move[:3, :3], scale, scale * move[:3, 3]), scene)
    export = save(export, folder)
    (folder / "input_frame_idx.txt").write_text("0\n1\n2\n")
    common = {"fx": scene.K[0, 0], "fy": scene.K[1, 1], "cx": scene.K[0, 2], "cy": scene.K[1, 2], "w": 48, "h": 36}
    frames = [
        {"file_path": f"images/{n}", "w2c": m.tolist(), **common} for n, m in zip(scene.names, scene.w2c, strict=True)
    ]
    data = data_set(folder, scene, "images")["images"].parent
    return replace(export, options={"cameras": save_json(data / "opencv_cameras.json", {"frames": frames})})


def vica_splat(folder: Path) -> Export:
    """Write VicaSplat's: sorted, degree 4, poses without intrinsics as a list."""
    scene = replace(with_faint(made(40, 40)), names=("0.png", "1.png", "2.png"))
    export = save_pixels(Saver("gaussians.ply", "opacity", frame="camera", rest=72, least=0.005), scene, folder)
    write_images(folder / "context", scene)
    poses = export.world.move(scene.c2w)
    save_json(folder / "transforms.json", [{"transform_matrix": pose.tolist()} for pose in poses])
    return export


def re_splat(folder: Path) -> Export:
    """Write ReSplat's: a grid of a quarter of the photos' size, degree 3, turned into the middle camera."""
    scene = made()
    export = save_pixels(Saver("gaussians.ply", frame="middle", rest=45), scene, folder)
    larger = as_photos(scene, 4)
    write_images(folder / "input", larger)
    return replace(export, options=data_set(folder, larger, "cameras"))


# Voxels, points of no pixel, trained scenes


def vol_splat(folder: Path, *, cameras: bool) -> Export:
    """Write VolSplat's: voxels, padded to the number of pixels, trimmed as if they were a grid, as DepthSplat's."""
    scene = replace(made(56, 40), names=tuple(f"input_{name}" for name in NAMES))
    pixels = np.arange(3 * scene.height * scene.width).reshape(3, scene.height, scene.width)
    voxels = merge_voxels(scene, 0.06)
    padding = voxels[np.zeros(max(0, pixels.size - len(voxels)), int)]
    values = {"means": 0, "scales": 0.01, "opacities": 0.01, "sh0": 0.1}
    padding = replace(padding, **{k: np.full_like(getattr(padding, k), v) for k, v in values.items()})
    rows = Gaussians.concat([voxels, padding])[pixels[:, 8:-8, 8:-8].transpose(1, 2, 0).reshape(-1)]
    saver = Saver("gaussians/room.ply", frame="first")
    export = replace(save_unordered(saver, scene, rows, folder), quats=None)
    write_images(folder / "images/room/color", scene)
    return replace(export, options=data_set(folder, scene, "cameras") if cameras else {})


def any_splat(folder: Path) -> Export:
    """Write AnySplat's: among the photos, which it crops to squares, and no cameras."""
    scene = made(56, 56)
    saver = Saver("gaussians.ply", frame="camera", raw=True)
    export = save_unordered(saver, scene, merge_voxels(scene, 0.06), folder)
    write_images(folder, as_photos(scene, 2, border=8))
    return export


def ffgs(folder: Path) -> Export:
    """Write ffgs's example: voxels, and cameras at the size to which it crops the photos, which the user names."""
    scene = made()
    export = save_unordered(Saver("gaussians.ply"), scene, merge_voxels(scene, 0.06), folder)
    K = (scene.K / [[scene.width], [scene.height], [1]]).tolist()
    views = [
        {"index": i, "file": name, "c2w": pose.tolist(), "k_normalized": K}
        for i, (name, pose) in enumerate(zip(scene.names, scene.c2w, strict=True))
    ]
    document = {"frame": "model", "image_shape": [scene.height, scene.width], "views": views}
    save_json(folder / "cameras.json", document)
    return replace(export, options=data_set(folder, as_photos(scene, 2, border=8), "images"))


def world_mirror(version: int, folder: Path) -> Export:
    """Write WorldMirror's: voxels with cameras; the first version's ``images`` are squeezed where it cropped."""
    scene = replace(made(40, 30), names=tuple(f"image_{i:04d}.png" for i in (1, 2, 3)))
    saver = Saver("gaussians.ply", raw=True)
    place = folder if version == 1 else folder / "room/20261120_101500"
    export = save_unordered(saver, scene, merge_voxels(scene, 0.06), place)
    if version == 2:
        write_world_mirror(place / "camera_params.json", scene)
        return replace(export, path=place, options=data_set(folder, as_photos(scene, 2), "images"))
    squeezed = np.stack([cv2.resize(image, (40, 30)) for image in as_photos(scene, 1, border=10).images])
    write_images(folder / "images", replace(scene, images=squeezed))
    write_images(folder / "images_resized", scene)
    write_colmap_binary(folder / "sparse/0", scene)
    return export


def trained(saver: Saver, folder: Path, *, cameras: str) -> Export:
    """Write a trained scene: rows in no order, degree 3."""
    scene = made()
    gaussians = scene.gaussians[np.random.default_rng(0).permutation(len(scene.gaussians))[:3000]]
    world = World()
    if cameras == "nerfstudio":  # in a frame of its own, with the map into it
        move = np.concatenate([rotation(0.4, -0.7, 0.2), [[0.3], [0.1], [-0.5]]], 1)
        world = World(move[:, :3], 0.5, 0.5 * move[:, 3])
    export = save_unordered(saver, scene, gaussians, folder, world)
    if cameras == "nerfstudio":
        data = PlyData.read(str(folder / saver.place), mmap=False)
        data.comments = ["Generated by Nerstudio 1.1.5", "Vertical Axis: z"]
        data.write(str(folder / saver.place))
        save_json(folder / "dataparser_transforms.json", {"transform": move.tolist(), "scale": 0.5})
    if cameras == "INRIA":
        write_inria(folder / "cameras.json", scene)
        (folder / "cfg_args").touch()
        return replace(export, options=data_set(folder, scene, "images"))
    if cameras == "gsplat":
        (folder / "cfg.yml").touch()
        (folder / "ckpts").mkdir()
        (folder / "ckpts/ckpt_29999_rank0.pt").touch()
    return replace(export, options=data_set(folder, scene, "cameras", "images"))


def zip_splat(folder: Path) -> Export:
    """Write ZipSplat's: Gaussians of tokens, in the first camera's frame, and a film."""
    scene = made()
    some = np.random.default_rng(0).permutation(len(scene.gaussians))[:900]
    export = save_unordered(Saver("scene.ply", frame="camera", rest=9), scene, scene.gaussians[np.sort(some)], folder)
    (folder / "turntable.mp4").touch()
    return export


def lgm(folder: Path) -> Export:
    """Write LGM's: an object from four views of its own making, which are not kept; 14 columns."""
    scene = with_faint(made(32, 32))
    export = save_pixels(Saver("anya_rgba.ply", normals="", least=0.005), scene, folder)
    (folder / "anya_rgba.mp4").touch()
    return export


def splatter_image(folder: Path) -> Export:
    """Write the demo's: one photo, degree 1, faint pixels left out, turned for a viewer."""
    scene = with_faint(made(48, 48, 1))
    saver = Saver("mesh.ply", rest=9, least=0.08)
    pixels = pixel_rows(saver, scene).pixels
    assert pixels is not None
    world = World(matmul(rotation(0, 0, np.pi / 2), rotation(-np.pi / 2, 0, 0)))
    export = save(finish_rows(saver, scene, pixels, world, scene), folder)
    return replace(export, path=folder / "mesh.ply", options=data_set(folder, scene, "cameras", "images"))


def flash_3d(folder: Path, *, cameras: bool) -> Export:
    """Write Flash3D's: one photo, two layers one after the other."""
    scene = made(48, 36, 1)
    export = save_pixels(Saver("scene.ply", "layer-major", layers=2, frame="upright", raw=True), scene, folder)
    return replace(export, options=data_set(folder, scene, "cameras", "images") if cameras else {})


def sharp(folder: Path) -> Export:
    """Write SHARP's: two layers on a square grid whatever the photo's shape, its camera among the elements."""
    scene = made(48, 48, 1)
    export = pixel_rows(Saver("photo.ply", "layer-major", layers=2, frame="camera", normals=""), scene)
    folder.mkdir(parents=True)
    K = scene.K * np.array([[64 / 48], [1], [1]])
    write_elements(folder / "photo.ply", export.rows, np.eye(4).reshape(-1), K.reshape(-1), (64, 48))
    photo = cv2.resize(scene.images[0], (64, 48))[..., ::-1]
    cv2.imwrite(str(folder.parent / "photo.png"), photo)
    return replace(export, path=folder / "photo.ply", options={"images": folder.parent})


def points_only(model: str, folder: Path) -> Export:
    """Write what models of points leave: photos, COLMAP's files and a point cloud, and no Gaussians."""
    scene = made()
    columns = [*((name, "f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    save_export(folder / "sparse", scene, np.zeros(50, columns), cameras=False, name="points.ply")
    write_colmap_binary(folder / "sparse", scene)
    write_images(folder / "images", scene)
    if model == "VGGT":
        arrays = {"extrinsic": scene.w2c[:, :3], "intrinsic": np.tile(scene.K, (3, 1, 1)), "images": scene.images}
        np.savez(folder / "predictions.npz", **arrays)
    return Export(folder, scene, np.zeros(0), World(), None, np.zeros(0))


def npz_alone(name: str, folder: Path) -> Export:
    """Write what Depth Anything 3 leaves where no ``gs_ply`` is asked for."""
    depth_anything("glb-npz", folder)
    (folder / "gs_ply/0000.ply").unlink()
    (folder / "gs_ply").rmdir()
    return Export(folder / name if name else folder, made(), np.zeros(0), World(), None, np.zeros(0))


SCRIPT = "point_clouds/000000_room/gaussians.ply"  # of the figure scripts of pixelSplat's family
_UPRIGHT_SCRIPT = Saver(SCRIPT, "view-fastest", 8, frame="upright", raw=True)
_BOTH, _SQUARE, _PAIR = ("cameras", "images"), (64, 64, 3), (64, 64, 2)
_FULL = Saver("gaussians.ply", frame="camera", raw=True)
_YONO = Saver("debug_info/room_gaussians.ply", "view-fastest", 8, raw=True, least=0.01)
_VIEWS_14 = Saver("output.ply", normals="", least=0.005)

MODELS: dict[str, Callable[[Path], Export]] = {
    "Depth Anything 3, npz-gs_ply": partial(depth_anything, "npz-gs_ply"),
    "Depth Anything 3, mini_npz-gs_ply": partial(depth_anything, "mini_npz-gs_ply"),
    "Depth Anything 3, glb-npz-gs_ply": partial(depth_anything, "glb-npz-gs_ply"),
    "Depth Anything 3, colmap-npz-gs_ply": partial(depth_anything, "colmap-npz-gs_ply"),
    "Depth Anything 3, colmap-gs_ply": partial(depth_anything, "colmap-gs_ply", photos=1),
    "Depth Anything 3, gs_ply": partial(depth_anything, "gs_ply", photos=1),
    "Depth Anything 3, npz": partial(npz_alone, ""),
    "Depth Anything 3, results.npz": partial(npz_alone, "exports/npz/results.npz"),
    "Depth Anything 3, scene.glb": partial(npz_alone, "scene.glb"),
    "Lyra 2": lyra,
    "DepthSplat": depth_splat,
    "DepthSplat without cameras": partial(depth_splat, cameras=False),
    "DepthSplat, the .ply alone": partial(depth_splat, cameras=False, photos=False),
    "ZPressor": partial(
        dataset_model, Saver("gaussians/room.ply", "view-fastest", 4, frame="first", raw=True), _BOTH, _SQUARE
    ),
    "MVSplat's script": partial(dataset_model, _UPRIGHT_SCRIPT, _BOTH, _PAIR),
    "MVSplat's script with its far cut": partial(dataset_model, _UPRIGHT_SCRIPT, _BOTH, _PAIR, far=0.9),
    "pixelSplat": partial(
        dataset_model, Saver("outputs/gaussians/run/010000.ply", layers=3, frame="upright", raw=True),
        _BOTH, (48, 48, 2),
    ),
    "pixelSplat's script": partial(dataset_model, _UPRIGHT_SCRIPT, _BOTH, _PAIR),
    "SPFSplat": spfsplat,
    "FreeSplat": free_splat,
    "NoPoSplat": partial(dataset_model, _FULL, ("images",), (48, 48, 2)),
    "NoPoSplat with the user's own photos": partial(dataset_model, _FULL, ("images",), (48, 48, 2), factor=2, border=8),
    "Splatt3R": partial(dataset_model, _FULL, ("images",), (64, 48, 2)),
    "Splatt3R with the user's own photos": partial(
        dataset_model, _FULL, ("images",), (64, 48, 2), factor=2
    ),
    "YoNoSplat": partial(dataset_model, _YONO, _BOTH, _SQUARE, faint=True),
    "YoNoSplat with the user's own photos": partial(dataset_model, _YONO, ("images",), _SQUARE, factor=2, border=8),
    "VicaSplat": vica_splat,
    "ReSplat": re_splat,
    "VolSplat": partial(vol_splat, cameras=True),
    "VolSplat without cameras": partial(vol_splat, cameras=False),
    "Long-LRM": long_lrm,
    "Long-LRM, sorted": partial(long_lrm, order="opacity"),
    "GS-LRM": partial(dataset_model, _VIEWS_14, _BOTH, _SQUARE, faint=True),
    "GRM": partial(dataset_model, replace(_VIEWS_14, least=0), _BOTH, _SQUARE),
    "FlashWorld": partial(dataset_model, Saver("output.ply", frame="camera", normals=""), _BOTH, (48, 36, 3)),
    "LGM": lgm,
    "Splatter Image": splatter_image,
    "Flash3D": partial(flash_3d, cameras=True),
    "Flash3D without cameras": partial(flash_3d, cameras=False),
    "SHARP": sharp,
    "AnySplat": any_splat,
    "ffgs": ffgs,
    "WorldMirror 1": partial(world_mirror, 1),
    "WorldMirror 2": partial(world_mirror, 2),
    "ZipSplat": zip_splat,
    "INRIA 3DGS": partial(trained, Saver("point_cloud/iteration_30000/point_cloud.ply", rest=45), cameras="INRIA"),
    "InstantSplat": partial(trained, Saver("point_cloud/iteration_1000/point_cloud.ply", rest=9), cameras="INRIA"),
    "nerfstudio": partial(trained, Saver("splat.ply", rest=45), cameras="nerfstudio"),
    "gsplat's trainer": partial(trained, Saver("ply/point_cloud_29999.ply", rest=45, normals=""), cameras="gsplat"),
    "MapAnything": partial(points_only, "MapAnything"),
    "VGGT": partial(points_only, "VGGT"),
}  # fmt: skip
