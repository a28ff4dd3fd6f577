"""The rasterizer on three scenes, against the sketch it grew from, as ratios within one run.

    python benchmarks/rasterizer.py [S1 S2 S3] [--repeats 7]

S1: 100 k Gaussians of 1.4 px, 476 x 476. S2: 1 M of 1.2 px, 640 x 480. S3: 20 k of 7 px, 476 x 476.

The raster's backward pass ends with 9 sums per Gaussian; ``projection`` takes them to means, quaternions, scales and
opacities, ``colours`` those of the colours to the spherical harmonics and the means, in the memory of the last ones as
in a training loop.

Milliseconds are process CPU time on one thread, best of the repeats, kernels warm; ours and the sketch's runs take
turns. ``dB`` is the PSNR against float64 renders. Scenes, renders and sketch are looked for in ``GSMERGE_SHARED``
and in ``../shared`` next to the repository; without them there is nothing to measure.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from gsmerge.kernels.raster.blend import SUMS, blend_backward, gather_slots  # noqa: E402
from gsmerge.raster import composite, contributions, prepare, splat_adjoint, tile_view  # noqa: E402
from gsmerge.raster.composite import view_colors  # noqa: E402
from gsmerge.raster.gradient import color_gradients, gradients_of  # noqa: E402
from gsmerge.raster.metrics import psnr  # noqa: E402
from gsmerge.runtime.threads import available_threads, use_threads  # noqa: E402
from gsmerge.types import Gaussians  # noqa: E402

SHARED = Path(os.environ.get("GSMERGE_SHARED", ROOT.parent / "shared"))


def load(path: Path) -> ModuleType:
    """A script as a module, under a name that is nobody else's."""
    spec = importlib.util.spec_from_file_location(f"shared_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def load_sketch() -> ModuleType:
    folder = SHARED / "prototypes"
    if importlib.util.find_spec("numba") is None:
        raise SystemExit("expected numba, which the sketch is written in; run pip install numba")
    import numba

    numba.set_num_threads(1)
    return load(folder / "rasterizer.py")


class Clock:
    """Best CPU milliseconds per name."""

    def __init__(self) -> None:
        self.best: dict[str, float] = defaultdict(lambda: float("inf"))

    def __call__(self, name: str, function: Callable[[], Any], clock: Callable[[], float] = time.process_time) -> Any:
        start = clock()
        result = function()
        self.best[name] = min(self.best[name], 1e3 * (clock() - start))
        return result


def walk_back(tiled: Any, image: Any, transmittance: Any, gradient: Any, colors: Any) -> None:
    """The raster's part of :func:`gradients_of`, its own memory included."""
    slots = np.empty((len(tiled.flatten_ids), SUMS), np.float32)
    tiles, none = len(tiled.isect_offsets) - 1, np.empty((0, 0), np.float32)
    blend_backward(*tiled.lists, colors, 0, tiles, image, transmittance, gradient, none, slots)
    gather_slots(tiled.flatten_ids, slots, 0, len(tiled.ids), np.zeros((len(tiled.ids), SUMS), np.float32))


def measure(scene: dict[str, Any], degree: int, sketch: ModuleType, repeats: int) -> tuple[dict[str, float], Any]:
    """Best times of both, and our image."""
    columns, num = {key: scene[key] for key in ("means", "quats", "scales", "opacities")}, (degree + 1) ** 2
    sh = scene["sh"][:, :num]
    splats = prepare(Gaussians(**columns, sh0=sh[:, :1], shN=sh[:, 1:]), np.zeros(3))
    view = scene["viewmat"], scene["K"], int(scene["width"]), int(scene["height"])
    theirs = dict(scene, sh=np.ascontiguousarray(scene["sh"][:, :num]), deg=degree, W=view[2], H=view[3])
    raster, clock = sketch.Raster(1), Clock()
    gradient = np.random.default_rng(0).normal(size=(view[3], view[2], 3)).astype(np.float32)
    for _ in range(repeats + 1):
        clock("sketch forward", lambda: raster.forward(theirs))
        clock("sketch backward", lambda: raster.sums(gradient))
        tiled = clock("tile", lambda: tile_view(splats, *view))
        image, _ = clock("composite", lambda tiled=tiled: composite(tiled))
        clock("adjoint", lambda tiled=tiled: splat_adjoint(tiled, gradient))
        clock("contributions", lambda tiled=tiled: contributions(tiled))
    (image, left), colors = composite(tiled), view_colors(tiled)
    shade = None
    for _ in range(repeats + 1):
        clock("sketch backward", lambda: raster.sums(gradient))
        clock("raster backward", lambda: walk_back(tiled, image, left, gradient, colors))
        expected = clock("gradients", lambda: gradients_of(tiled, colors, image, left, gradient, None, False))
        shade = clock(
            "color gradients",
            lambda expected=expected, shade=shade: color_gradients(tiled, expected.colors, colors, used=shade),
        )
    return clock.best, image


def wall(scene: dict[str, Any], threads: int, repeats: int) -> float:
    """Best wall milliseconds of tiling and compositing one view."""
    columns = [scene[key] for key in ("means", "quats", "scales", "opacities")]
    splats = prepare(Gaussians(*columns, scene["sh"][:, :1], scene["sh"][:, :0]), np.zeros(3))
    view, clock = (scene["viewmat"], scene["K"], int(scene["width"]), int(scene["height"])), Clock()
    with use_threads(threads):
        for _ in range(repeats):
            clock("forward", lambda: composite(tile_view(splats, *view)), time.perf_counter)
    return clock.best["forward"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="*", default=["S1", "S2", "S3"])
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    if not (SHARED / "golden" / "scenes.py").is_file() or not (SHARED / "prototypes" / "rasterizer.py").is_file():
        print("nothing to measure: set GSMERGE_SHARED to the folder with golden/ and prototypes/")
        return
    generator, sketch = load(SHARED / "golden" / "scenes.py"), load_sketch()
    print("| scene | SH | tile | composite | forward | sketch | ratio | adjoint | sketch backward | ratio "
          "| contributions | dB |")  # fmt: skip
    print("|-|-|-|-|-|-|-|-|-|-|-|-|")
    speedups, backward = [], []
    for name in args.scenes:
        scene = generator.make(*generator.SPEC[name])
        for degree in (0, 3):
            with use_threads(1):
                t, image = measure(scene, degree, sketch, args.repeats)
            golden = SHARED / "golden" / f"{name}_sh{degree}_rgb.npy"
            quality = f"{psnr(image, np.load(golden)):.1f}" if golden.is_file() else "-"
            forward = t["tile"] + t["composite"]
            print(f"| {name} | {degree} | {t['tile']:.1f} | {t['composite']:.1f} | {forward:.1f} "
                  f"| {t['sketch forward']:.1f} | {forward / t['sketch forward']:.2f} | {t['adjoint']:.1f} "
                  f"| {t['sketch backward']:.1f} | {t['adjoint'] / t['sketch backward']:.2f} "
                  f"| {t['contributions']:.1f} | {quality} |", flush=True)  # fmt: skip
            rest = t["gradients"] - t["raster backward"], t["color gradients"]
            backward.append(f"| {name} | {degree} | {t['raster backward']:.1f} | {t['sketch backward']:.1f} "
                            f"| {t['raster backward'] / t['sketch backward']:.2f} | {rest[0]:.1f} | {rest[1]:.1f} "
                            f"| {sum(rest) / t['raster backward']:.2f} |")  # fmt: skip
        speedups.append((name, wall(scene, 1, args.repeats), wall(scene, available_threads(), args.repeats)))
    print("\n| scene | SH | raster backward | sketch | ratio | projection backward | colours backward "
          "| both / raster |\n|-|-|-|-|-|-|-|-|", *backward, sep="\n")  # fmt: skip
    print(f"\n| scene | forward wall, 1 thread | {available_threads()} threads |\n|-|-|-|")
    for name, one, all_threads in speedups:
        print(f"| {name} | {one:.1f} ms | {all_threads:.1f} ms |")


if __name__ == "__main__":
    main()
