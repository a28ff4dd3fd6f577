"""What the trained networks gain on real scenes: learned against analytic at equal counts, and stage by stage.

python benchmarks/networks.py eval                      # the tables of docs/internals/networks.md; what is done is kept
python benchmarks/networks.py train --only gain
python benchmarks/networks.py fox,fern --checkpoint FILE
python benchmarks/networks.py eval --only paper --no-lpips --checkpoint gsmerge/networks/paper.safetensors

Plain exports, held-out views, pixels that the context views see; LPIPS (VGG) of two held-out views of each scene.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shared_scenes import LEFT_OUT, export, read_held_out, scene_folders

import gsmerge
from gsmerge.measure.evaluate import EvaluateOptions, evaluate
from gsmerge.networks.checkpoint import SHIPPED, load_checkpoint, save_checkpoint
from gsmerge.networks.options import SLOTS
from gsmerge.research.charts.lines import Interval, mean_interval, paired_difference
from gsmerge.types import Views
from gsmerge.views import even_views, subset

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
BUDGET = {1: "4.4%", 2: "8.8%", 4: "17.6%"}
ONE = {"budget": BUDGET[1]}
GAIN = (
    Condition("no fit", {**ONE, **PLAIN}),
    Condition("12 steps", {**ONE, "fit_steps": 12}),
    Condition("default fit", ONE),
    Condition("no fit, 3 views", {**ONE, **PLAIN}, 3),
    Condition("default fit, 3 views", ONE, 3),
)
MANY = tuple(Condition(f"K = {k}, no fit", {"k": k, "budget": BUDGET[k], **PLAIN}) for k in (2, 4))
ABLATION = (
    Condition("without the refiner", {**ONE, **PLAIN}, silent="refiner", learned=(True,)),
    Condition("without the merger", {**ONE, **PLAIN}, silent="merger", learned=(True,)),
    Condition("without both", {**ONE, **PLAIN}, silent="refiner,merger", learned=(True,)),
    Condition("the encoder's latent zero", {**ONE, **PLAIN}, silent="latent", learned=(True,)),
    Condition("all latents zero", {**ONE, **PLAIN}, silent="latents", learned=(True,)),
    Condition("without the heads", {**ONE, **PLAIN}, silent="heads", learned=(True,)),
    Condition("no merging across views", {**ONE, **PLAIN, "match": "none"}),
    Condition("matching by the K = 1 head", {**ONE, **PLAIN, "geometry": "decoded"}, learned=(True,)),
    Condition("larger superpixels", {"budget": "2%", **PLAIN}),
    Condition("smaller superpixels", {"budget": "8.7%", **PLAIN}),
)
OWN = {"recipe": "paper", **ONE}
PAPER = (
    Condition("the whole, K = 1", OWN, learned=(True,)),
    Condition("moment matching", {"method": "moment-matching", **ONE}, learned=(False,)),
    *(Condition(f"K = {k}", {"recipe": "paper", "k": k, "budget": BUDGET[k]}, learned=(True,)) for k in (2, 4)),
    Condition("no merging across views", {**OWN, "match": "none"}, learned=(True,)),
    *(Condition(f"without the {name}", OWN, silent=name, learned=(True,)) for name in ("merger", "refiner", "heads")),
    Condition("the encoder's latents zero", OWN, silent="latent", learned=(True,)),
    Condition("geometry of the moments for matching", {**OWN, "geometry": "analytic"}, learned=(True,)),
    *(
        Condition(f"cosine of at least {cosine}", {**OWN, "similarity": cosine}, learned=(True,))
        for cosine in (0.9, 0.95, 0.98)
    ),
)
PARTS = {"gain": GAIN, "children": MANY, "ablation": ABLATION, "paper": PAPER}


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


def measured(folder: Path, condition: Condition, checkpoint: str, cache: Path, lpips: bool) -> dict[str, Any]:
    """One run on one scene, judged by its held-out views."""
    scene, targets = gsmerge.read_scene(export(folder, cache)), read_held_out(folder)
    if condition.views is not None:
        scene = subset(scene, even_views(len(scene), min(condition.views, len(scene))))
    start = time.perf_counter()
    chosen = {"checkpoint": checkpoint, "require_checkpoint": checkpoint != "none"}
    result = gsmerge.compact(scene, **condition.settings, **chosen)
    seconds = time.perf_counter() - start
    views = Views(targets.cameras, targets.images, tuple(map(str, range(len(targets.images)))))
    options = EvaluateOptions(lpips=("vgg",) if lpips else (), lpips_views=2, context=False, own=False)
    scores = evaluate(scene, {"it": result.gaussians}, views, options).results[0].scores
    means: dict[str, float] = {}
    for name in MEASURES:
        values = [value for s in scores if (value := getattr(s.masked, name)) is not None]
        if values:
            means[name] = sum(values) / len(values)
    stages = {name: result.report.seconds[name] for name in STAGES if name in result.report.seconds}
    choices = result.report.choices
    kept = choices["clusters"] / choices["groups"] if "clusters" in choices else 1.0
    return {"count": len(result.gaussians), "seconds": seconds, "stages": stages, "kept": kept, **means}


def runs_of(folders: list[Path], conditions: tuple[Condition, ...], args: argparse.Namespace) -> Iterator[None]:
    """Run what is not done yet."""
    digest = hashlib.sha256(args.checkpoint.read_bytes()).hexdigest()[:16]
    with tempfile.TemporaryDirectory() as place:
        for folder in folders:
            for condition in conditions:
                for learned in condition.learned:
                    key = key_of(folder, condition, digest if learned else "none", args.lpips)
                    if key in args.store.runs:
                        continue
                    checkpoint = "none"
                    if learned:
                        quiet = condition.silent
                        checkpoint = str(silenced(args.checkpoint, quiet, Path(place)) if quiet else args.checkpoint)
                    run = measured(folder, condition, checkpoint, args.cache, args.lpips)
                    args.store.add(
                        {"key": key, "scene": folder.name, "name": condition.name, "learned": learned, **run}
                    )
                    print(
                        json.dumps({"scene": folder.name, "name": condition.name, "learned": learned, **run}),
                        flush=True,
                    )
                    yield


def key_of(folder: Path, condition: Condition, checkpoint: str, lpips: bool) -> str:
    what = [folder.name, condition.settings, condition.views, condition.silent, checkpoint, lpips]
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:24]


def table(folders: list[Path], conditions: tuple[Condition, ...], args: argparse.Namespace) -> str:
    """Markdown: means over the scenes, and the paired difference with its 95 % interval."""
    digest = hashlib.sha256(args.checkpoint.read_bytes()).hexdigest()[:16]
    rows = [
        "| | analytic | learned | PSNR, learned less analytic (95 %) | worst scene | LPIPS, likewise |",
        "|---|" + "---|" * 5,
    ]
    base = {learned: scores(folders, GAIN[0], digest if learned else "none", args) for learned in (False, True)}
    for condition in conditions:
        both = {
            learned: scores(folders, condition, digest if learned else "none", args) for learned in condition.learned
        }
        before, after = both.get(False, base[True] if condition.learned == (True,) else {}), both.get(True, {})
        if len(after) < len(folders):
            continue
        gain = paired_difference(pick(after, "psnr"), pick(before, "psnr"))
        worst = min(after[s]["psnr"] - before[s]["psnr"] for s in after)
        lpips = [run["lpips_vgg"] - before[s]["lpips_vgg"] for s, run in after.items() if "lpips_vgg" in run]
        lpips_gain = "" if not lpips else f"{mean_interval(lpips).mean:+.3f}"
        first = summary(before) if False in condition.learned else "(whole, no fit) " + summary(before)
        rows.append(f"| {condition.name} | {first} | {summary(after)} | {words(gain)} | {worst:+.2f} | {lpips_gain} |")
    return "\n".join(rows)


def paper_table(folders: list[Path], conditions: tuple[Condition, ...], args: argparse.Namespace) -> str:
    """Markdown: means over the scenes, against the whole recipe."""
    digest = hashlib.sha256(args.checkpoint.read_bytes()).hexdigest()[:16]
    rows = ["| | groups kept across views | PSNR / SSIM | against the whole (95 %) |", "|---|---|---|---|"]
    whole = scores(folders, conditions[0], digest, args)
    for condition in conditions:
        runs = scores(folders, condition, digest if condition.learned == (True,) else "none", args)
        kept = sum(run["kept"] for run in runs.values()) / len(runs)
        gain = words(paired_difference(pick(runs, "psnr"), pick(whole, "psnr"))) if runs is not whole else ""
        rows.append(f"| {condition.name} | {100 * kept:.0f} % | {summary(runs)} | {gain} |")
    return "\n".join(rows)


def scores(
    folders: list[Path], condition: Condition, digest: str, args: argparse.Namespace
) -> dict[str, dict[str, Any]]:
    keys = {folder.name: key_of(folder, condition, digest, args.lpips) for folder in folders}
    return {name: args.store.runs[key] for name, key in keys.items() if key in args.store.runs}


def pick(runs: dict[str, dict[str, Any]], name: str) -> dict[str, float]:
    return {scene: run[name] for scene, run in runs.items()}


def summary(runs: dict[str, dict[str, Any]]) -> str:
    means = {
        name: sum(r[name] for r in runs.values()) / len(runs)
        for name in MEASURES
        if all(name in r for r in runs.values())
    }
    return " / ".join(f"{value:.2f}" if name == "psnr" else f"{value:.3f}" for name, value in means.items())


def words(interval: Interval) -> str:
    return f"{interval.mean:+.2f} ({interval.low:+.2f} to {interval.high:+.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--only", nargs="*", default=list(PARTS)[:3], choices=list(PARTS))
    parser.add_argument("--checkpoint", type=Path, default=SHIPPED)
    parser.add_argument("--no-lpips", dest="lpips", action="store_false")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    args.store = Store(args.cache / "networks.jsonl")
    folders = [folder for folder in scene_folders(args.scenes) if folder.name not in LEFT_OUT]
    for part in args.only:
        conditions = tuple(condition for condition in PARTS[part] if applies(condition, args.checkpoint))
        for _ in runs_of(folders, conditions, args):
            pass
        names = ", ".join(folder.name for folder in folders)
        rows = (paper_table if part == "paper" else table)(folders, conditions, args)
        print(f"\n{part}: {names}\n\n{rows}\n", flush=True)


if __name__ == "__main__":
    main()
