"""Exports of several backbones, read without a flag: recovered pixels, CPU seconds, quality after compaction.

python benchmarks/exporters.py eval                          # reading alone, all views
python benchmarks/exporters.py fox,fern --views 3 6 0        # 0: all views
python benchmarks/exporters.py eval --quality                # also compact K = 1, visible PSNR of held-out views
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from quality import score
from shared_scenes import Targets, exporter, read_held_out, scene_folders

import gsmerge
from gsmerge.alignment import Recovery
from gsmerge.scene.read import Loaded, load_scene

STYLES: dict[str, tuple[str, float]] = {
    "plain": ("plain", 1.0),
    "da3": ("da3", 1.0),
    "da3 nested": ("da3", 1.7),
    "da3 photos": ("da3", 1.0),  # without cameras and depth maps
    "depthsplat": ("depthsplat", 1.0),
    "anysplat": ("anysplat", 1.0),
    "volsplat": ("volsplat", 1.0),
}


@dataclass(frozen=True)
class Truth:
    """Which pixel of which view every row of an export is: ``[n]`` in the grid of the views that were written."""

    pixels: np.ndarray


def true_pixels(scene: Path, style: str, max_views: int | None) -> Truth | None:
    """The pixel of every row, from the data that the export was made from; None for voxels."""
    views = exporter().read_scene(scene, max_views)
    height, width = views[0]["depth"].shape
    grid = np.arange(height * width).reshape(height, width)
    if style == "plain":
        return Truth(np.arange(len(views) * grid.size))
    if style == "da3":
        top, left = int(8 / 256 * height), int(8 / 256 * width)
        kept = []
        for i, view in enumerate(views):
            mask = np.zeros((height, width), bool)
            mask[top : height - top, left : width - left] = True
            mask &= view["depth"] <= np.quantile(view["depth"], 0.9)
            kept.append(i * grid.size + grid[mask])
        return Truth(np.concatenate(kept))
    if style == "depthsplat":
        inner = grid[8:-8, 8:-8].reshape(-1)
        return Truth(np.stack([i * grid.size + inner for i in range(len(views))], 1).reshape(-1))
    return None


def export_volsplat(scene: Path, out: Path, max_views: int | None) -> Path:
    """Voxels in the frame of the first camera, filled up to all pixels, without borders, with the set's cameras."""
    tool = exporter()
    views, rng = tool.read_scene(scene, max_views), np.random.default_rng(0)
    rows = tool.concat([tool.view_gaussians(view, rng) for view in views])
    voxels = tool.voxel_merge(rows, np.median([np.median(v["depth"]) / v["K"][0, 0] for v in views]))
    voxels["opacities"] = voxels["opacities"].clip(0.01, 0.99)
    height, width = views[0]["depth"].shape
    fill = len(views) * height * width - len(voxels["means"])
    empty = {"means": 0.0, "quats": 0.5, "scales": 0.01, "opacities": 0.01, "sh0": 0.1}
    padding = {name: np.full((fill, *voxels[name].shape[1:]), value) for name, value in empty.items()}
    inner = np.arange(len(views) * height * width).reshape(-1, height, width)[:, 8:-8, 8:-8]
    trimmed = tool.take(tool.concat([voxels, padding]), inner.transpose(1, 2, 0).reshape(-1))
    ply: Path = out / "gaussians.ply"
    tool.write_ply(ply, tool.rotate_world(trimmed, views[0]["c2w"][:3, :3].T))
    tool.write_transforms(out / "transforms.json", views)
    tool.write_images(out / "images", views)
    return ply


def share_at_home(loaded: Loaded, truth: Truth | None) -> float:
    """Share of the file's rows that were put to their own pixel; NaN where there is no truth or no pixels."""
    if loaded.recovery is None or truth is None:
        return float("nan")
    layout = loaded.recovery.best.layout
    size, recovered = layout.width * layout.height, np.full(len(truth.pixels), -1)
    for view, rows, pixels in zip(layout.views, layout.rows, layout.pixels, strict=True):
        recovered[rows.reshape(-1)] = view * size + pixels
    return float((recovered == truth.pixels).mean())


def measure(scene: Path, name: str, max_views: int, cache: Path, quality: bool) -> dict[str, Any]:
    """One line of the table."""
    style, nested = STYLES[name]
    out = cache / f"{scene.name}-{name.replace(' ', '-')}-{max_views}"
    if style == "volsplat":
        ply = export_volsplat(scene, out, max_views or None)
    else:
        ply = exporter().export(scene, out, style, max_views or None, nested)
    if name == "da3 photos":
        shutil.rmtree(out / "exports")
        exporter().write_images(out / "images", exporter().read_scene(scene, max_views or None))
    start = time.process_time()
    loaded = load_scene(ply)
    row: dict[str, Any] = {"scene": scene.name, "style": name, "views": max_views or "all"}
    row["seconds"] = time.process_time() - start
    row["aligned"] = loaded.scene.aligned
    row["at home"] = share_at_home(loaded, true_pixels(scene, style, max_views or None))
    row["margin"] = loaded.recovery.margin if loaded.recovery else float("nan")
    if quality:
        result = gsmerge.compact(loaded.scene, k=1)
        row["kept"] = len(result.gaussians) / loaded.scene.num_gaussians
        row["psnr"] = score(result.gaussians, _targets(scene, loaded.recovery, nested))[0]
    return row


def _targets(scene: Path, recovery: Recovery | None, nested: float) -> Targets:
    """The held-out views in the frame of the Gaussians."""
    targets = read_held_out(scene)
    if recovery is None:
        return targets
    viewmats = targets.cameras.viewmats.copy()
    viewmats[:, :3, 3] *= nested  # into the world of the exported cameras
    moved = recovery.best.frame.move_viewmats(viewmats)
    return replace(targets, cameras=replace(targets.cameras, viewmats=moved))


def _line(row: dict[str, Any]) -> str:
    cells = [f"{row['scene']:<11}{row['style']:<12}{row['views']!s:>5}", f"{row['seconds']:7.1f} CPU s"]
    cells.append("pixels" if row["aligned"] else "unaligned ")
    cells.append(f"{100 * row['at home']:8.3f} % at home, margin {row['margin']:7.0f}")
    if "psnr" in row:
        cells.append(f"kept {100 * row['kept']:.2f} %, {row['psnr']:.2f} dB")
    return "  ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--styles", default=",".join(STYLES), help="names with commas between")
    parser.add_argument("--views", type=int, nargs="+", default=[0], help="views that are exported; 0: all")
    parser.add_argument("--quality", action="store_true", help="also compact with K = 1 and score held-out views")
    parser.add_argument("--cache", type=Path, help="folder for the exports; a temporary one if not given")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for folder in scene_folders(args.scenes):
            for name in args.styles.split(","):
                for views in args.views:
                    row = measure(folder, name, views, args.cache or Path(temporary), args.quality)
                    print(_line(row), flush=True)


if __name__ == "__main__":
    main()
