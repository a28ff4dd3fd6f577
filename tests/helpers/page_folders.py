"""Folders with the files that pages name in their commands, made of small scenes."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
from scripts import EXAMPLES
from shared import make_once, write_scene, write_small, write_smallest
from sharp_files import split_views, write_sharp

import gsmerge
from gsmerge.cli import main

BATCHES = {"monday": slice(0, 3), "tuesday": slice(2, 5)}  # views of two batches of one scene
# Files and folders that a page's folder has only if the page names them, and does not begin with writing them
COPIES = ("a.ply", "b.ply", "room.ply", "hall.ply")  # of small.ply
IF_NAMED = ("small.ply", *COPIES, "room.gsm", "point_cloud.ply", "demo/scene.compact.ply", "demo", "masks")
WRITES = r'(?:-o |\.save\("|gsmerge extend |01_make_scene\.py )'  # stands before the name of what is written


def write_page_folder(folder: Path, blocks: str) -> Path:
    """Copy what the blocks of a page need into a new folder, with a link to ``examples/``."""
    shutil.copytree(make_once("pages", _write_files), folder)
    (folder / "examples").symlink_to(EXAMPLES)
    for name in IF_NAMED:
        path = folder / name
        first = re.search(rf"({WRITES})?(?<![\w./-]){re.escape(name)}", blocks)
        if first is not None and not first[1]:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
            path.with_suffix(".cameras.json").unlink(missing_ok=True)
    return folder


def _write_files(folder: Path) -> None:
    """Write all files: ``scene.ply`` with ``images/`` and ``transforms.json``, folders of scenes, results, masks."""
    write_small(folder)
    shutil.rmtree(folder / "targets")
    for name in ("scene", "demo"):
        write_small(folder / name)
    for name in ("a", "b"):
        write_smallest(folder / "scenes" / name)
    for name, views in BATCHES.items():
        _write_batch(folder / name, folder / "scene", views)
    _write_sharp_files(folder)
    _write_masks(folder)
    for command, source, result in (
        ("compact", "scene.ply", "small.ply"),
        ("compact", "demo", "demo/scene.compact.ply"),
        ("extend", "monday", "room.gsm"),
    ):
        paths = [folder / source, "-o", folder / result] if command == "compact" else [folder / result, folder / source]
        assert main([command, *map(str, paths), "--quiet"]) == 0
    for name in COPIES:
        shutil.copy(folder / "small.ply", folder / name)
    gaussians = gsmerge.read_ply(folder / "scene.ply").gaussians  # of a trained scene, which belong to no pixels
    gsmerge.write_ply(folder / "point_cloud.ply", gaussians[np.random.default_rng(0).permutation(len(gaussians))[::3]])


def _write_batch(folder: Path, scene: Path, views: slice) -> None:
    """Write some of the views of a scene: their Gaussians, cameras and photos."""
    cameras = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    gaussians = gsmerge.read_ply(scene / "scene.ply").gaussians
    size = len(gaussians) // len(cameras["frames"])
    shutil.copytree(scene / "images", folder / "images")
    gsmerge.write_ply(folder / "scene.ply", gaussians[views.start * size : views.stop * size])
    cameras["frames"] = cameras["frames"][views]
    (folder / "transforms.json").write_text(json.dumps(cameras), encoding="utf-8")


def _write_sharp_files(folder: Path) -> None:
    """Write ``out/IMG_0001.ply`` and more of three views, and their photos in ``photos/``."""
    scene = gsmerge.read_scene(make_once("sharp", lambda place: write_scene(place, num_views=3, width=64, height=48)))
    (folder / "out").mkdir()
    (folder / "photos").mkdir()
    size = (2 * scene.cameras.width, 2 * scene.cameras.height)
    for number, view in enumerate(split_views(scene, (1.1, 0.85, 1.0)), start=1):
        name = f"IMG_{number:04}"
        write_sharp(folder / "out" / f"{name}.ply", view, size, folder / "photos" / f"{name}.jpg")


def _write_masks(folder: Path) -> None:
    """Write ``masks/``, which leave out the left part of each photo, and ``signs/``, white in the middle."""
    for name in ("masks", "signs"):
        (folder / name).mkdir()
    for photo in (folder / "images").iterdir():
        height, width = cv2.imread(str(photo)).shape[:2]
        mask, sign = np.full((height, width), 255, np.uint8), np.zeros((height, width), np.uint8)
        mask[:, : width // 8] = 0
        sign[height // 3 : height // 2, width // 3 : width // 2] = 255
        cv2.imwrite(str(folder / "masks" / photo.with_suffix(".png").name), mask)
        cv2.imwrite(str(folder / "signs" / photo.with_suffix(".png").name), sign)
