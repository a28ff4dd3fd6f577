"""What a report expects of new views, against photos that were not used; and how much depth other views confirm.

python benchmarks/new_views.py eval,train
python benchmarks/new_views.py fern,fox --style da3 --set effort=best

For each capture (docs/internals/captures.md): bounds of the gain that the report of a run expects, the gain at the
targets, over the pixels that input views see, that of the run's own photos, dB; and the shares of confirmed depth.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import gettempdir

import numpy as np
from quality import setting
from shared_scenes import export, read_held_out, scene_folders

import gsmerge
from gsmerge.types import Views

QUICK = gsmerge.EvaluateOptions(lpips=(), fog=False, context=False)


def measure(scene_folder: Path, style: str, settings: dict[str, object]) -> tuple[float, ...]:
    """Return bounds of the gain expected, the gain at targets and of own photos, three shares of depth, CPU seconds."""
    scene, held_out = gsmerge.read_scene(export(scene_folder, CACHE, style)), read_held_out(scene_folder)
    start = time.process_time()
    result = gsmerge.compact(scene, **settings)
    seconds, report = time.process_time() - start, result.report
    names = tuple(str(place) for place in range(len(held_out.images)))
    targets = Views(held_out.cameras, held_out.images, names)
    before, after = (
        scores.mean("target")[1].psnr
        for scores in gsmerge.evaluate(scene, {"result": result.gaussians}, targets, QUICK).results
    )
    bounds = (np.nan, np.nan) if report.new_views is None else report.new_views.bounds
    agreement = report.choices.get("agreement", dict.fromkeys(("confirmed", "contradicted", "alone"), np.nan))
    own = report.psnr_after - report.psnr_before
    return *bounds, after - before, own, *agreement.values(), seconds


CACHE = Path(gettempdir()) / "gsmerge-exports"

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--style", default="plain")
    parser.add_argument("--set", action="append", default=[], type=setting, help="a setting of compact, NAME=VALUE")
    options = parser.parse_args()
    folders = [folder for split in options.scenes.split(",") for folder in scene_folders(split)]
    print("|capture|expected|at targets|own photos|confirmed|contradicted|alone|\n|---|---:|---:|---:|---:|---:|---:|")
    rows = []
    for folder in folders:
        rows.append(measure(folder, options.style, dict(options.set)))
        low, high, gain, own, *shares, _ = rows[-1]
        cells = [f"{low:+.1f} to {high:+.1f}", f"{gain:+.1f}", f"{own:+.1f}", *(f"{share:.2f}" for share in shares)]
        print(f"|{'|'.join([folder.name, *cells])}|", flush=True)
    known = [row for row in rows if np.isfinite(row[0])]
    print(f"within the bounds: {sum(low <= gain <= high for low, high, gain, *_ in known)} of {len(known)}")
