"""Memory and steps per second of ``gsmerge lab train``: streamed examples, or all in memory.

python benchmarks/training.py made    # 200 scenes of gsmerge lab generate, streamed and in memory

The folder is filled with scenes and their examples first, which is resumed if it was interrupted. Each measurement is a
process of its own, and all of them draw the same windows. Processor seconds hardly depend on what else runs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from gsmerge.research.generate import GenerateOptions, generate
from gsmerge.research.training import TrainOptions, prepare_shards, preset_options, read_shard, train
from gsmerge.research.training import shards as streams
from gsmerge.runtime.memory import peak_memory

WARM = 10  # steps before the clock starts: kernels are loaded, readers are ahead
LINE = "{:<28} {:>10} {:>12} {:>16} {:>10}"


def options_of(args: argparse.Namespace) -> TrainOptions:
    return replace(
        preset_options("paper"), lpips_weight=0.0, steps=args.steps + WARM, save_every=10**6, crops=args.crops,
        validation_examples=1, validation_windows=1,
    )  # fmt: skip


def measure(args: argparse.Namespace, kind: str) -> None:
    """In a process of its own: prepare, or prepare and train; prints JSON."""
    scenes, options = sorted((args.folder / "scenes").glob("scene_*")), options_of(args)
    shards = prepare_shards(scenes[: args.scenes], options, args.folder / "examples")
    facts = {"shards": len(shards), "bytes": sum(shard.path.stat().st_size for shard in shards)}
    if kind != "prepare":
        if kind == "memory":
            examples = {shard: read_shard(shard) for shard in shards}
            streams.read_shard = lambda shard, check: examples[shard]  # type: ignore[assignment]
        marks: list[tuple[float, float]] = []

        def mark(*_: float) -> None:
            marks.append((time.perf_counter(), time.process_time()))

        with tempfile.TemporaryDirectory() as out:
            train(shards, shards[:1], Path(out), options, threads=args.threads, progress=mark)
        (start, start_cpu), (end, end_cpu) = marks[WARM - 1], marks[-1]
        facts |= {"seconds": end - start, "processor": end_cpu - start_cpu}
    print(json.dumps({**facts, "peak": peak_memory()}), flush=True)


def run(args: argparse.Namespace, kind: str) -> dict[str, float]:
    """What :func:`measure` prints in a process of its own."""
    own = [__file__, args.folder, "--measure", kind, "--scenes", args.scenes, "--steps", args.steps]
    own += ["--crops", args.crops, "--threads", args.threads]
    done = subprocess.run([sys.executable, *map(str, own)], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--crops", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--measure", choices=("prepare", "streamed", "memory"))
    args = parser.parse_args()
    if args.measure:
        measure(args, args.measure)
        return
    width, height = map(int, args.size.split("x"))
    made = GenerateOptions(width=width, height=height, views=args.views)
    generate(args.folder / "scenes", args.scenes, made)
    print(LINE.format("", "peak, GB", "steps per s", "processor s/step", "ratio"))
    prepared = run(args, "prepare")
    print(LINE.format("prepare", f"{prepared['peak'] / 1e9:.2f}", "", "", ""), flush=True)
    print(f"{prepared['shards']} examples, {prepared['bytes'] / 1e9:.2f} GB")
    first = None
    for kind in ("memory", "streamed"):
        facts = run(args, kind)
        speed = args.steps / facts["seconds"]
        first = first or speed
        cpu = f"{facts['processor'] / args.steps:.3f}"
        print(LINE.format(kind, f"{facts['peak'] / 1e9:.2f}", f"{speed:.3f}", cpu, f"{speed / first:.2f}"), flush=True)


if __name__ == "__main__":
    main()
