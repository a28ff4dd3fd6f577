"""Levels of detail on real scenes: ours, and those that splat-transform makes of our finest one, at equal counts.

python benchmarks/levels.py fern,apples                 # needs splat-transform on the PATH
python benchmarks/levels.py eval --levels 4 --ways decimate
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

from quality import score
from shared_scenes import export, read_held_out, scene_folders

import gsmerge
from gsmerge.io import read_ply, write_ply
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.io.formats.streamed import read_level, write_levels

WAYS = ("decimate", "decimate-adaptive")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--levels", type=int, default=3)
    parser.add_argument("--ways", nargs="*", default=WAYS, help="options of splat-transform that take a number")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    args.cache.mkdir(exist_ok=True)
    program = find_program()
    for folder in scene_folders(args.scenes):
        scene, targets = gsmerge.read_scene(export(folder, args.cache)), read_held_out(folder)
        result = gsmerge.compact(scene, levels=args.levels)
        chain = [one.gaussians for one in (result, *result.coarser)]
        with tempfile.TemporaryDirectory() as name:
            index, finest = Path(name) / "lod-meta.json", Path(name) / "0.ply"
            write_levels(index, chain)
            write_ply(finest, chain[0])
            for level, own in enumerate(chain):
                streamed = read_level(index, level)
                num_bytes = streamed.info.file_bytes - index.stat().st_size
                rows = {"ours": own, f"streamed, {num_bytes:,} bytes": streamed.gaussians}
                for way in args.ways if level else ():
                    target = Path(name) / f"{level}-{way}.ply"
                    before = Path(name) / f"{level - 1}-{way}.ply" if level > 1 else finest
                    call = [program, "-q", "-w", "-g", "cpu", str(before), f"--{way}", str(len(own)), str(target)]
                    subprocess.run(call, check=True)
                    rows[f"splat-transform {way}"] = read_ply(target).gaussians
                for kind, gaussians in rows.items():
                    psnr, ssim = score(gaussians, targets)
                    line = f"{folder.name:12s} level {level}  {len(gaussians):>9,}  {psnr:6.2f} dB  {ssim:.3f}  {kind}"
                    print(line, flush=True)


if __name__ == "__main__":
    main()
