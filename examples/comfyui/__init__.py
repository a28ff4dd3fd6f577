"""Nodes for ComfyUI that compact Gaussian splats; README.md beside this file says how to install them."""

from pathlib import Path
from typing import Any

import comfy.model_management
import comfy.utils
import folder_paths
import numpy as np
import torch
from comfy_api.latest import IO, ComfyExtension, Types

import gsmerge

UNITS = 1000  # length of the progress bar
FLIP = np.diag([1.0, -1, -1])  # from three.js' axes (y up, z backward) to those of a splat (y down, z forward)
CHOICES = [  # inputs of both nodes
    IO.String.Input("budget", default="", tooltip="How many to keep: 20000, 4%, 5MB or mobile; empty: as many as pay."),
    IO.Combo.Input("effort", options=["default", "draft", "fast", "best"], tooltip="draft: a quarter of the time."),
]


def make_progress() -> Any:
    """Return a progress function for gsmerge, which moves the bar of the running node and ends a cancelled run."""
    bar, place = comfy.utils.ProgressBar(UNITS), [0, 1]  # number of the current stage, and number of stages

    def move(stage: str, done: int, total: int) -> None:
        """Move the bar; names of steps within a stage have a colon."""
        comfy.model_management.throw_exception_if_processing_interrupted()
        if ": " not in stage:
            place[:] = done, max(1, total)
        step = done / max(1, total) if ": " in stage else 0
        bar.update_absolute(round(UNITS * min(1, (place[0] + step) / place[1])))

    return move


def place_camera(camera: dict[str, Any], width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return view matrix (OpenCV axes, world of the splat) and K of a camera of ComfyUI, as Render Splat uses it."""
    if str(camera.get("cameraType", "")).lower().startswith("ortho"):
        raise ValueError("camera_info: expected perspective cameras, found an orthographic one")
    eye, target = (np.array([float(camera[name].get(axis, 0)) for axis in "xyz"]) for name in ("position", "target"))
    if camera.get("quaternion"):
        w, x, y, z = (float(camera["quaternion"].get(axis, 0)) for axis in "wxyz")
        w, x, y, z = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    else:
        back = (eye - target) / np.linalg.norm(eye - target)
        right = np.cross([0, 1, 0] if abs(back[1]) < 0.999 else [0, 0, 1], back)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(back, right), back], 1)
    pose = np.eye(4)  # camera to world
    pose[:3, :3], pose[:3, 3] = FLIP @ rotation @ FLIP, FLIP @ eye
    tangent = np.tan(np.radians(float(camera.get("fov") or 35)) / 2)  # the field of view is that of the shorter side
    focal = min(width, height) / 2 / tangent * float(camera.get("zoom") or 1)
    return np.linalg.inv(pose), np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def place_views(images: list[torch.Tensor], cameras: list[dict[str, Any]]) -> dict[str, Any]:
    """Return batches of images ``[b,h,w,3]`` and their cameras as arguments; ValueError if they do not fit."""
    if len({image.shape[1:3] for image in images}) > 1:
        raise ValueError("images: expected one size")
    photos = torch.cat([image[..., :3] for image in images])
    if len(photos) != len(cameras):
        raise ValueError(f"camera_info: expected one for each of {len(photos)} images, found {len(cameras)}")
    placed = [place_camera(camera, photos.shape[2], photos.shape[1]) for camera in cameras]
    viewmats, Ks = (np.stack(arrays) for arrays in zip(*placed, strict=True))
    return {"images": photos.clamp(0, 1), "viewmats": viewmats, "Ks": Ks}


def split_batch(splat: Types.SPLAT) -> list[dict[str, torch.Tensor]]:
    """Return the columns of each item of a batch, under gsmerge's names."""
    counts = [splat.positions.shape[1]] * len(splat.positions) if splat.counts is None else splat.counts.tolist()
    columns = {"means": splat.positions, "quats": splat.rotations, "scales": splat.scales}
    columns |= {"opacities": splat.opacities[..., 0], "sh0": splat.sh[:, :, :1], "shN": splat.sh[:, :, 1:]}
    return [{name: column[i, :n] for name, column in columns.items()} for i, n in enumerate(counts)]


def join_batch(items: list[gsmerge.Gaussians]) -> Types.SPLAT:
    """Return several Gaussians as one batch, in which shorter items are filled up with zeros."""
    columns = [(g.means, g.scales, g.quats, g.opacities[:, None], torch.cat([g.sh0, g.shN], 1)) for g in items]
    padded = [torch.nn.utils.rnn.pad_sequence(list(column), batch_first=True) for column in zip(*columns, strict=True)]
    return Types.SPLAT(*padded, torch.tensor([len(g) for g in items]) if len(items) > 1 else None)


class CompactGaussians(IO.ComfyNode):
    @classmethod
    def define_schema(cls) -> IO.Schema:
        return IO.Schema(
            node_id="GsmergeCompactGaussians", display_name="Compact Gaussians", category="3d/splat",
            is_input_list=True,  # so that many cameras come as a list beside a batch of images
            description="Keep 1 to 10 % of the Gaussians, fitted to the images. Without images it keeps the look.",
            search_aliases=["reduce splat", "simplify gaussian", "decimate splat", "gsmerge"],
            inputs=[IO.Splat.Input("splat"), *CHOICES,
                    IO.Image.Input("images", optional=True, tooltip="Photos or renders of this splat."),
                    IO.Load3DCamera.Input("camera_info", optional=True, tooltip="A list of one for each image.")],
            outputs=[IO.Splat.Output(is_output_list=True), IO.String.Output("report", is_output_list=True)],
        )  # fmt: skip

    @classmethod
    def execute(cls, splat, budget, effort, images=None, camera_info=None) -> IO.NodeOutput:
        batches = [split_batch(batch) for batch in splat]
        if bool(images) != bool(camera_info) or (images and sum(map(len, batches)) > 1):
            raise ValueError("images, camera_info: expected both of them, and one splat, or neither")
        settings: Any = {"budget": budget[0].strip() or None, "effort": effort[0], "order": "none"}
        settings |= place_views(images, camera_info) if images else {}
        results = [
            [gsmerge.compact_tensors(**columns, progress=make_progress(), **settings) for columns in batch]
            for batch in batches
        ]
        reports = ["\n".join([str(result.report), *result.report.notes]) for batch in results for result in batch]
        return IO.NodeOutput([join_batch([result.gaussians for result in batch]) for batch in results], reports)


class CompactFile(IO.ComfyNode):
    @classmethod
    def define_schema(cls) -> IO.Schema:
        return IO.Schema(
            node_id="GsmergeCompactFile", display_name="Compact File (Gaussians)", category="3d/splat",
            is_output_node=True, description="Compact a file or the folder of a scene as gsmerge compact does.",
            inputs=[IO.String.Input("scene", tooltip="A path on the server, or below ComfyUI's input folder."),
                    *CHOICES, IO.Combo.Input("format", options=["ply", "spz", "sog", "splat", "glb", "html"]),
                    IO.String.Input("filename_prefix", default="3d/compact")],
            outputs=[IO.File3DAny.Output("model_3d"), IO.String.Output("report")],
        )  # fmt: skip

    @classmethod
    def fingerprint_inputs(cls, scene, **_) -> float:
        path = Path(folder_paths.get_input_directory(), scene)
        return max((file.stat().st_mtime for file in (path, *path.rglob("*")) if file.exists()), default=0.0)

    @classmethod
    def execute(cls, scene, budget, effort, format, filename_prefix) -> IO.NodeOutput:
        path = Path(folder_paths.get_input_directory(), scene)
        where, name, i, *_ = folder_paths.get_save_image_path(filename_prefix, folder_paths.get_output_directory())
        output = Path(where, f"{name}_{i:05}_.{format}")
        result = gsmerge.compact(path, progress=make_progress(), budget=budget.strip() or None, effort=effort)
        result.save(output)
        return IO.NodeOutput(Types.File3D(str(output)), "\n".join([str(result.report), *result.report.notes]))


class Nodes(ComfyExtension):
    async def get_node_list(self) -> list[type[IO.ComfyNode]]:
        return [CompactGaussians, CompactFile]


async def comfy_entrypoint() -> Nodes:
    return Nodes()
