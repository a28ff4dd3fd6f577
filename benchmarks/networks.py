"""What the trained networks gain on real scenes: learned against analytic at equal counts, and stage by stage.

python benchmarks/networks.py eval                     # the tables of docs/internals/networks.md; what is done is kept
python benchmarks/networks.py train --only gain
python benchmarks/networks.py fox,fern --checkpoint FILE

Plain exports, held-out views, pixels that the context views see; LPIPS (VGG) of two held-out views of each scene.
Nothing has a budget: without a fit, superpixels are then cut for it, and K does not matter. Networks that raise
opacities leave out fewer Gaussians as too faint, so of two runs that are compared the larger one loses its faintest.
The paper's own method: paper_tables.py.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
import time
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from shared_scenes import LEFT_OUT, export, read_held_out, scene_folders

import gsmerge
from gsmerge.facts.views import even_views, subset
from gsmerge.measure.evaluate import EvaluateOptions, evaluate
from gsmerge.networks.checkpoint import SHIPPED, load_checkpoint, save_checkpoint
from gsmerge.networks.options import SLOTS
from gsmerge.research.charts.lines import Interval, mean_interval
from gsmerge.stages.clean import faintest_dropped
from gsmerge.types import Views

MEASURES = ("psnr", "ssim", "lpips_vgg")
STAGES = ("encode", "match", "refine", "decode")  # that networks take part in


@dataclass(frozen=True)
class Condition:
    """A way to run; both with and without networks unless ``learned`` says otherwise."""

    name: str
    settings: dict[str, Any]
    views: int | None = None
    silent: str | None = None  # networks whose last layers are set to zero
    learned: tuple[bool, ...] = (False, True)


PLAIN = {"fit": "none"}
GAIN = (
    Condition("no fit", PLAIN),
    Condition("12 steps", {"fit_steps": 12}),
    Condition("default fit", {}),
    Condition("no fit, 3 views", PLAIN, 3),
    Condition("default fit, 3 views", {}, 3),
)
MANY = tuple(Condition(f"K = {k}, no fit", {"k": k, **PLAIN}) for k in (2, 4))
ABLATION = (
    Condition("without the refiner", PLAIN, silent="refiner", learned=(True,)),
    Condition("without the merger", PLAIN, silent="merger", learned=(True,)),
    Condition("without both", PLAIN, silent="refiner,merger", learned=(True,)),
    Condition("the encoder's latent zero", PLAIN, silent="latent", learned=(True,)),
    Condition("all latents zero", PLAIN, silent="latents", learned=(True,)),
    Condition("without the heads", PLAIN, silent="heads", learned=(True,)),
    Condition("no merging across views", {**PLAIN, "match": "none"}),
    Condition("larger superpixels", {"superpixels": "2%", **PLAIN}),
    Condition("smaller superpixels", {"superpixels": "8.7%", **PLAIN}),
)
PARTS = {"gain": GAIN, "children": MANY, "ablation": ABLATION}


@dataclass
class Store:
    """Finished runs by key, one JSON line each."""

    path: Path
    runs: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path.exists():
            for line in self.path.read_text().splitlines():
                run = json.loads(line)
                self.runs[run["key"]] = run

    def add(self, run: dict[str, Any]) -> None:
        self.runs[run["key"]] = run
        with self.path.open("a") as file:
            file.write(json.dumps(run) + "\n")


def silenced(checkpoint: Path, names: str, folder: Path) -> Path:
    """The checkpoint with the last layers of some networks at zero: they change nothing."""
    out = folder / f"without-{names.replace(',', '-')}.safetensors"
    networks = load_checkpoint(checkpoint).networks
    width, arrays = networks.options.latent, {name: array.copy() for name, array in networks.arrays.items()}
    for name in names.split(","):
        if name in ("latent", "latents"):
            last = ["encoder.latent."] + ["merger.out.", "refiner.out."] * (name == "latents")
        else:
            last = [f"heads.{slots}.out." for slots in SLOTS] if name == "heads" else [f"{name}.out."]
        for layer in (array for key, array in arrays.items() if key.startswith(tuple(last))):
            layer[-width if name in ("latent", "latents") else 0 :] = 0
    save_checkpoint(out, replace(networks, arrays=arrays), {})
    return out


def applies(condition: Condition, checkpoint: Path) -> bool:
    """Whether the checkpoint has the networks that a condition silences."""
    options = load_checkpoint(checkpoint).networks.options
    names = (condition.silent or "").replace("latents", "refiner").replace("latent", "encoder").split(",")
    return all(name in ("", "heads") or getattr(options, name) for name in names)


@lru_cache(maxsize=2)  # of a pair, the larger of which is scored again
def compacted(
    ply: Path, views: int | None, settings: tuple[tuple[str, Any], ...]
) -> tuple[gsmerge.Scene, gsmerge.CompactResult, float]:
    """Some views of a scene, their result, and the seconds that it took."""
    scene = gsmerge.read_scene(ply)
    if views is not None:
        scene = subset(scene, even_views(len(scene), min(views, len(scene))))
    start = time.perf_counter()
    result = gsmerge.compact(scene, **dict(settings))
    return scene, result, time.perf_counter() - start


def measured(
    folder: Path, condition: Condition, checkpoint: str, args: argparse.Namespace, count: int | None
) -> dict[str, Any]:
    """One run on one scene, judged by its held-out views; of more than ``count`` Gaussians the faintest go."""
    chosen = {"checkpoint": checkpoint, "require_checkpoint": checkpoint != "none"}
    settings = tuple((condition.settings | chosen).items())
    scene, result, seconds = compacted(export(folder, args.cache), condition.views, settings)
    targets = read_held_out(folder)
    gaussians = result.gaussians if count is None else faintest_dropped(result.gaussians, count)
    views = Views(targets.cameras, targets.images, tuple(map(str, range(len(targets.images)))))
    options = EvaluateOptions(lpips=("vgg",) if args.lpips else (), lpips_views=2, context=False, own=False, fog=False)
    scored = evaluate(scene, {"it": gaussians}, views, options).results[0]
    means: dict[str, float] = {}
    for name in MEASURES:
        values = [value for s in scored.scores if (value := getattr(s.masked, name)) is not None]
        if values:
            means[name] = sum(values) / len(values)
    stages = {name: result.report.seconds[name] for name in STAGES if name in result.report.seconds}
    facts = {"count": len(gaussians), "ratio": scored.ratio, "seconds": seconds, "stages": stages}
    return {**facts, **means}


def run(
    folder: Path, condition: Condition, args: argparse.Namespace, *, learned: bool, count: int | None = None
) -> dict[str, Any]:
    """The run of a condition on a scene: a finished one, or a new one, which is kept."""
    digest = hashlib.sha256(args.checkpoint.read_bytes()).hexdigest()[:16] if learned else "none"
    what = [folder.name, condition.settings, condition.views, condition.silent, digest, args.lpips, count]
    key = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:24]
    if key not in args.store.runs:
        with tempfile.TemporaryDirectory() as place:
            checkpoint = "none"
            if learned:
                quiet = condition.silent
                checkpoint = str(silenced(args.checkpoint, quiet, Path(place)) if quiet else args.checkpoint)
            figures = measured(folder, condition, checkpoint, args, count)
        one = {"scene": folder.name, "name": condition.name, "learned": learned, **figures}
        print(json.dumps(one), flush=True)
        args.store.add({"key": key, **one})
    return args.store.runs[key]


def at_equal_count(folder: Path, condition: Condition, args: argparse.Namespace) -> tuple[dict[str, Any], ...]:
    """Runs of one count: without and with networks, or, of a condition with networks alone, the whole and that."""
    first = (condition, False) if False in condition.learned else (GAIN[0], True)
    both = [(one, learned, run(folder, one, args, learned=learned)) for one, learned in (first, (condition, True))]
    count = min(done["count"] for *_, done in both)
    return tuple(
        done if done["count"] == count else run(folder, one, args, learned=learned, count=count)
        for one, learned, done in both
    )


def table(folders: list[Path], conditions: tuple[Condition, ...], args: argparse.Namespace) -> str:
    """Markdown: means over the scenes, and the paired difference with its 95 % interval."""
    rows = [
        "| | Gaussians | analytic | learned | PSNR, learned less analytic (95 %) | worst scene | LPIPS, likewise |",
        "|---|" + "---|" * 6,
    ]
    for condition in conditions:
        pairs = {folder.name: at_equal_count(folder, condition, args) for folder in folders}
        before, after = ({scene: pair[i] for scene, pair in pairs.items()} for i in (0, 1))
        gains = [after[s]["psnr"] - before[s]["psnr"] for s in after]
        gain, worst = mean_interval(gains), min(gains)
        lpips = [run["lpips_vgg"] - before[s]["lpips_vgg"] for s, run in after.items() if "lpips_vgg" in run]
        lpips_gain = "" if not lpips else f"{mean_interval(lpips).mean:+.3f}"
        first = summary(before) if False in condition.learned else "(whole, no fit) " + summary(before)
        cells = [condition.name, share(after), first, summary(after), words(gain), f"{worst:+.2f}", lpips_gain]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def pick(runs: dict[str, dict[str, Any]], name: str) -> dict[str, float]:
    return {scene: run[name] for scene, run in runs.items()}


def share(runs: dict[str, dict[str, Any]]) -> str:
    return f"{100 * sum(run['ratio'] for run in runs.values()) / len(runs):.1f} %"


def summary(runs: dict[str, dict[str, Any]]) -> str:
    means = {
        name: sum(r[name] for r in runs.values()) / len(runs)
        for name in MEASURES
        if all(name in r for r in runs.values())
    }
    return "/".join(f"{value:.2f}" if name == "psnr" else f"{value:.3f}" for name, value in means.items())


def words(interval: Interval) -> str:
    return f"{interval.mean:+.2f} ({interval.low:+.2f} to {interval.high:+.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--only", nargs="*", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--checkpoint", type=Path, default=SHIPPED)
    parser.add_argument("--no-lpips", dest="lpips", action="store_false")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    args.store = Store(args.cache / "networks.jsonl")
    folders = [folder for folder in scene_folders(args.scenes) if folder.name not in LEFT_OUT]
    for part in args.only:
        conditions = tuple(condition for condition in PARTS[part] if applies(condition, args.checkpoint))
        names = ", ".join(folder.name for folder in folders)
        print(f"\n{part}: {names}\n\n{table(folders, conditions, args)}\n", flush=True)


if __name__ == "__main__":
    main()
