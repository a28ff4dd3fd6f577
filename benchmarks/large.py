"""Seconds and memory of ``gsmerge compact`` on scenes of many views, and the estimates of ``gsmerge inspect``.

python benchmarks/large.py                                  # 84 views of a real scene, default settings
python benchmarks/large.py --views 12 84 --degrees 0 3 4 --settings "--fit none" "--effort draft"

Each run is a process of its own. Scenes are the repeated views of ``many_views`` in a plain export; higher harmonics
are added to its rows as small noise.
"""

from __future__ import annotations

import argparse
import json
import resource
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from capture_exports import ply_header, ply_rows, read_scene, view_gaussians, write_views
from many_views import many_views
from shared_scenes import scene_folders

import gsmerge

HARMONIC = 0.02  # size of the added harmonics
COLUMNS = (
    *("views", "Gaussians, million", "SH degree", "options", "result", "seconds", "estimated", "processor seconds"),
    *("peak, GB", "estimated", "bytes per Gaussian", "seconds of"),
)


def scene_of(name: str, views: int, degree: int, cache: Path) -> Path:
    """The plain export of a scene with its views repeated, with harmonics up to a degree; written once."""
    source = many_views(scene_folders(name)[0], cache / f"{name}-{views}", views)
    out = cache / f"{source.name}-degree{degree}"
    if not (out / "done").exists():
        write_export(source, out, degree)
        (out / "done").touch()
    return out / "scene.ply"


def write_export(source: Path, out: Path, degree: int) -> None:
    """What the exporter's style ``plain`` writes, view by view, as all at once would not fit; and harmonics."""
    views, num = read_scene(source), 3 * ((degree + 1) ** 2 - 1)
    write_views(out, views)
    rng, noise = np.random.default_rng(0), np.random.default_rng(1)
    with (out / "scene.ply").open("wb") as file:
        file.write(ply_header(sum(view["depth"].size for view in views), num))
        for view in views:
            harmonics = noise.normal(0, HARMONIC, (view["depth"].size, num))
            file.write(ply_rows(view_gaussians(view, rng), harmonics))


def measure(scene: Path, settings: str, out: Path) -> tuple[dict, float]:
    """The report of one run, and its processor seconds."""
    words = ["compact", str(scene), "-o", str(out / "out.ply"), "--overwrite", "--json"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call = [sys.executable, "-m", "gsmerge", *words, *shlex.split(settings)]
    document = json.loads(subprocess.run(call, check=True, stdout=subprocess.PIPE).stdout)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return document, seconds


def row(scene: Path, views: int, degree: int, settings: str, out: Path) -> str:
    """One run as a row of the table."""
    report, processor = measure(scene, settings, out)
    words = ["compact", str(scene), "-o", str(out / "out.ply"), "--dry-run", "--json", *shlex.split(settings)]
    plan = subprocess.run(
        [sys.executable, "-m", "gsmerge", *words, "--overwrite"], check=True, capture_output=True, text=True
    )
    guess = json.loads(plan.stdout)["compact"]
    count, peak = report["input"]["num_gaussians"], report["peak_memory_bytes"]
    stages = sorted(report["seconds"].items(), key=lambda item: -item[1])
    longest = ", ".join(f"{name} {seconds:.0f}" for name, seconds in stages if name != "total" and seconds >= 1)
    cells = [
        str(views), f"{count / 1e6:.1f}", str(degree), f"`{settings or 'default'}`",
        f"{report['output']['num_gaussians']:,}", f"{sum(s for n, s in stages if n != 'total'):.0f}",
        f"{guess['seconds']:.0f}", f"{processor:.0f}", f"{peak / 1e9:.1f}", f"{guess['memory_bytes'] / 1e9:.1f}",
        f"{peak / count:.0f}", longest,
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", default="redkitchen", help="one of the scenes next to the repository")
    parser.add_argument("--views", type=int, nargs="*", default=[84])
    parser.add_argument("--degrees", type=int, nargs="*", default=[0], help="of the harmonics, 0 to 4")
    parser.add_argument("--settings", nargs="*", default=[""], help="options of compact, one string a run")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-large", help="scenes")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    scene_folders(args.scene)  # which says at once that it is not there
    print(f"gsmerge {gsmerge.__version__}")
    print("| " + " | ".join(COLUMNS) + " |")
    print("|" + "---|" * len(COLUMNS))
    for views in args.views:
        for degree in args.degrees:
            scene = scene_of(args.scene, views, degree, args.cache)
            for settings in args.settings:
                with tempfile.TemporaryDirectory() as folder:
                    print(row(scene, views, degree, settings, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
