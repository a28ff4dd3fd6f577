"""Hostile inputs through the whole command: a result or one clear line, whatever a file holds.

python benchmarks/hostile.py                          # 1,000 inputs over all readers; about twenty minutes
python benchmarks/hostile.py --table                  # those of the table in tests/hostile, which tests plan only
python benchmarks/hostile.py --only sog "gsm, state" --count 100
python benchmarks/hostile.py --only sog --case 17 --keep DIR    # one of them again, its files kept

Each generated input is a sound file of its kind with something changed: bytes, words of a header, numbers, entries of a
document, also inside what is compressed. Each runs in a process of its own with limits of memory and processor time,
forked from one that has imported everything. Checked are exit code, errors, output folder, input, and the peak of
memory: that of the sound file's run, and three times the input.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import random
import re
import shutil
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

import forked_commands
import numpy as np
from forked_commands import Outcome
from hostile import CASES, MARKER, array_files, camera_models, ply_files
from hostile.case import cameras_of
from hostile.changes import (
    Mutate,
    another_picture,
    any_of,
    change_bytes,
    change_json,
    change_lines,
    change_ply_head,
    change_text,
    change_words,
    in_safetensors,
    inside_gzip,
    inside_zip,
    member,
)

import gsmerge
from gsmerge.cli import main as command

ROOT = Path(__file__).resolve().parent.parent
COUNT = 1000
LIMITS = forked_commands.Limits(3 << 30, 100)
TIMES_INPUT, SLACK = 3, 32 << 20  # memory beyond the sound run's: times the input, and what differs by chance
CODES = (0, 2, 3, 4, 5)
FAST = ("--effort", "draft", "--set", "fit_steps=4", "--threads", "1", "--set", "checkpoint=none")


@dataclass(frozen=True)
class Kind:
    """A kind of file, where the sound one is, and what reads it."""

    share: int  # of the inputs
    files: tuple[str, ...]  # below the folder; one of them is changed
    change: Mutate
    words: Callable[[Path, Path], list[str]]  # of the folder with the input and of the output folder
    outputs: tuple[str, ...] = ("a.ply",)  # that a run that ends well leaves


def compact(scene: str = "scene.ply", *more: str) -> Callable[[Path, Path], list[str]]:
    return lambda folder, out: ["compact", str(folder / scene), "-o", str(out / "a.ply"), *FAST, *more]


def compact_with(cameras: str) -> Callable[[Path, Path], list[str]]:
    return lambda folder, out: compact("scene.ply", "--cameras", str(folder / cameras))(folder, out)


def change_any(rng: random.Random, data: bytes) -> bytes:
    """Bytes or words of any file, or of what is compressed in it."""
    inside = {b"\x1f\x8b": inside_gzip(change_words), b"PK": inside_zip(member)}.get(data[:2], change_words)
    return any_of(change_bytes, change_words, inside)(rng, data)


CHECKED = (
    "scene.ply", "ascii.ply", "a.compressed.ply", "a.spz", "a.splat", "a.sog", "a.glb", "a.gsm", "state.gsm",
    "transforms.json", "cameras/views.npz", "cameras/cameras.json", "cameras/text/cameras.txt",
    "cameras/binary/images.bin", "checkpoint.safetensors",
)  # fmt: skip
KINDS = {
    "ply": Kind(120, ("scene.ply",), any_of(change_bytes, change_words, change_ply_head), compact()),
    "ply, ascii": Kind(80, ("ascii.ply",), any_of(change_bytes, change_text, change_ply_head), compact("ascii.ply")),
    "compressed.ply": Kind(50, ("a.compressed.ply",), any_of(change_bytes, change_words, change_ply_head),
                           compact("a.compressed.ply")),
    "spz": Kind(80, ("a.spz",), any_of(change_bytes, inside_gzip(any_of(change_bytes, change_words))),
                compact("a.spz")),
    "splat": Kind(40, ("a.splat",), any_of(change_bytes, change_words), compact("a.splat")),
    "sog": Kind(90, ("a.sog",), any_of(change_bytes, inside_zip(member), inside_zip(member)), compact("a.sog")),
    "glb": Kind(60, ("a.glb",), any_of(change_bytes, change_words), compact("a.glb")),
    "gsm": Kind(70, ("a.gsm",), any_of(change_bytes, in_safetensors, in_safetensors),
                lambda folder, out: ["compact", str(folder / "a.gsm"), "-o", str(out / "a.ply"), "--fit", "none",
                                     "--threads", "1"]),
    "gsm, two batches": Kind(50, ("state.gsm",), any_of(change_bytes, in_safetensors, in_safetensors),
                             lambda folder, out: ["compact", str(folder / "state.gsm"), "-o", str(out / "a.ply"),
                                                  "--set", "fit_steps=4", "--threads", "1"]),
    "views.npz": Kind(70, ("cameras/views.npz",), any_of(change_bytes, inside_zip(member)),
                      compact_with("cameras/views.npz")),
    "transforms.json": Kind(80, ("transforms.json",), any_of(change_json, change_json, change_bytes), compact()),
    "cameras.json": Kind(60, ("cameras/cameras.json",), any_of(change_json, change_json, change_bytes),
                         compact_with("cameras/cameras.json")),
    "COLMAP, text": Kind(50, ("cameras/text/cameras.txt", "cameras/text/images.txt"),
                         any_of(change_text, change_bytes), compact_with("cameras/text")),
    "COLMAP, binary": Kind(50, ("cameras/binary/cameras.bin", "cameras/binary/images.bin"),
                           any_of(change_words, change_bytes), compact_with("cameras/binary")),
    "images": Kind(50, tuple(f"images/view_00{i}.png" for i in range(3)), any_of(change_bytes, another_picture),
                   compact()),
    "batch.jsonl": Kind(20, ("batch/batch.jsonl",), change_lines,
                        lambda folder, out: ["batch", str(folder / "scene.ply"), "-o", str(out), "--jobs", "1",
                                             "--overwrite", *FAST], ("scene.ply", "batch.jsonl", "summary.csv")),
    "batch.jsonl of runs": Kind(20, ("charts/batch.jsonl",), change_lines,
                       lambda folder, out: ["chart", "--draw-only", "-o", str(out)], ("index.html",)),
    "list of scenes": Kind(20, ("list.txt",), any_of(change_text, change_bytes),
                           lambda folder, out: ["batch", str(folder / "list.txt"), "-o", str(out), "--jobs", "1",
                                                "--name", "{index}.ply", *FAST], ("batch.jsonl", "summary.csv")),
    "check": Kind(60, CHECKED, change_any,
                  lambda folder, out: ["check", *(str(folder / name) for name in CHECKED)], ()),
    "check, gsm": Kind(30, ("a.gsm", "state.gsm", "checkpoint.safetensors"), in_safetensors,
                       lambda folder, out: ["check", *(str(folder / name) for name in CHECKED)], ()),
    "checkpoint": Kind(20, ("checkpoint.safetensors",), any_of(change_bytes, in_safetensors, in_safetensors),
                       lambda folder, out: [*compact()(folder, out)[:-1],
                                            f"checkpoint={folder}/checkpoint.safetensors"]),
}  # fmt: skip
STARTED_FROM = {
    "batch.jsonl": "batch",
    "batch.jsonl of runs": "charts",
}  # kinds that are in the output folder themselves


def make_scene(folder: Path) -> Path:
    importlib.import_module("01_make_scene").make_scene(folder, num_views=3, width=24, height=16)
    shutil.rmtree(folder / "targets")
    return folder


def make_inputs(folder: Path) -> Path:
    """A sound file of every kind."""
    make_scene(folder)
    gaussians = gsmerge.read_ply(folder / "scene.ply").gaussians
    for name in ("a.spz", "a.splat", "a.sog", "a.glb", "a.compressed.ply"):
        gsmerge.write_gaussians(folder / name, gaussians)
    _write_ascii(folder)
    _write_cameras(folder)
    (folder / "list.txt").write_text("# scenes\nscene.ply\na.spz\nascii.ply\nscene.ply\n")
    quick = ["--effort", "draft", "--threads", "1", "--quiet"]
    for words in (
        ["extend", folder / "a.gsm", folder / "scene.ply", "--checkpoint", "none", *quick],
        ["extend", folder / "state.gsm", *[folder / "scene.ply"] * 2, "--checkpoint", "none", *quick],
        ["batch", folder / "scene.ply", "-o", folder / "batch", "--jobs", "1", *FAST, "--quiet"],
        ["chart", folder / "scene.ply", "-o", folder / "charts", "--fit", "none", "--methods", "gsmerge,random",
         "--budgets", "2%,5%", "--quiet"],
    ):  # fmt: skip
        if command([str(word) for word in words]):
            raise SystemExit(f"failed: {words}")
    shutil.copy(ROOT / "gsmerge" / "networks" / "shipped.safetensors", folder / "checkpoint.safetensors")
    return folder


def _write_ascii(folder: Path) -> None:
    sound = (folder / "scene.ply").read_bytes()
    ply_files.text(lambda rows: rows)(folder)
    (folder / "scene.ply").rename(folder / "ascii.ply")
    (folder / "scene.ply").write_bytes(sound)


def _write_cameras(folder: Path) -> None:
    (c2w, K), place = cameras_of(folder), folder / "cameras"
    place.mkdir()
    np.savez(place / "views.npz", **array_files.arrays_of(folder, "views.npz"))
    (place / "cameras.json").write_text(json.dumps(camera_models.inria(c2w, K)))
    for name, suffix in (("text", "txt"), ("binary", "bin")):
        (place / name).mkdir()
        for part, data in zip(("cameras", "images"), camera_models.colmap(c2w, K, text=name == "text"), strict=True):
            (place / name / f"{part}.{suffix}").write_bytes(data)


def run_forked(words: list[str]) -> Outcome:
    """The command in a child of this process, in limits."""
    return forked_commands.run_forked(partial(command, words), LIMITS)


def contents(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def sizes(folder: Path) -> dict[str, int]:
    """Of files that may be too large to read, and of links that lead nowhere."""
    return {str(path.relative_to(folder)): path.lstat().st_size for path in sorted(folder.rglob("*"))}


def try_kind(name: str, inputs: Path, place: Path, rng: random.Random | None) -> tuple[Outcome, list[str], int]:
    """A file of a kind, changed or sound, through its command: outcome, faults, and bytes of the input."""
    kind, folder, out = KINDS[name], place / "in", place / "made"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(inputs, folder)
    if rng is not None:
        path = folder / rng.choice(kind.files)
        path.write_bytes(kind.change(rng, path.read_bytes()))
    out.mkdir()
    if name in STARTED_FROM:
        shutil.copytree(folder / STARTED_FROM[name], out, dirs_exist_ok=True)
    before, earlier = contents(folder), contents(out)
    outcome = run_forked(kind.words(folder, out))
    faults = _check_end(outcome)
    if contents(folder) != before:
        faults.append("the input has changed")
    faults += _check_outputs(name, outcome.code, out, earlier)
    return outcome, faults, sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def try_case(name: str, scene: Path, place: Path) -> list[str]:
    """Faults of an input of the table that is compacted for real."""
    shutil.rmtree(place, ignore_errors=True)
    folder, case = Path(shutil.copytree(scene, place / "in" / "scene")), CASES[name]
    words = [str(word) for word in case.spoil(folder) or [folder]]
    before = sizes(folder.parent)
    outcome = run_forked(["compact", "--quiet", *FAST, *(["--"] if words[0].startswith("-") else []), *words])
    codes = {*case.codes, 3} if 0 in case.codes else case.codes  # the table's are those of a plan
    faults = _check_end(outcome) + ([f"exit code {outcome.code}"] if outcome.code not in codes else [])
    if outcome.code and sizes(folder.parent) != before:
        faults.append("something was written")
    if list(place.rglob(MARKER)):
        faults.append("something was executed")
    return [f"{fault}: {outcome.err.strip()[-300:]!r}" for fault in faults]


def run_table(folder: Path) -> int:
    """Number of inputs of the table with faults, which are printed."""
    scene = make_scene(folder / "sound")
    words = ["compact", str(scene), "-o", str(folder / "a.ply"), *FAST]
    if command(words):
        raise SystemExit("the sound scene failed")
    faulty = {name: faults for name in CASES if (faults := try_case(name, scene, folder / "place"))}
    for name, faults in faulty.items():
        print(f"{name}: {'; '.join(faults)}", flush=True)
    print(f"{len(CASES)} inputs of the table, {len(faulty)} with faults")
    return len(faulty)


def _check_end(outcome: Outcome) -> list[str]:
    """What is wrong with exit code and errors."""
    lines = [line for line in outcome.err.splitlines() if line.startswith("gsmerge: error: ")]
    faults = []
    if outcome.code not in CODES:
        faults.append(f"exit code {outcome.code}")
    if "Traceback" in outcome.err or re.search(
        "unexpected error|gsmerge: warning(?!: the result shows)|Warning:", outcome.err
    ):
        faults.append("traceback, unexpected error or warning")
    if (outcome.code != 0) != (len(lines) == 1) or not all(line.isprintable() for line in outcome.err.splitlines()):
        faults.append(f"{len(lines)} lines of error")
    if outcome.code and outcome.err.splitlines()[-1:] != lines[-1:]:
        faults.append("the error is not the last line")
    return faults


def _check_outputs(name: str, code: int, out: Path, earlier: dict[str, str]) -> list[str]:
    """What is wrong with the output folder."""
    after, outputs = contents(out), KINDS[name].outputs
    hidden = [path for path in after if Path(path).name.startswith(".") and path not in earlier]
    faults = [f"left {hidden}"] if hidden else []
    if code in (2, 3) and set(after) - set(earlier):
        faults.append(f"exit code {code}, and wrote {sorted(set(after) - set(earlier))}")
    if code == 0:
        faults += [f"{path} is missing" for path in outputs if path not in after]
        for path in out.glob("*.ply"):
            try:
                found = gsmerge.read_ply(path)
                if found.info.num_nonfinite or not len(found.gaussians):
                    faults.append(f"{path.name}: {found.info.num_nonfinite} rows are not finite")
            except Exception as error:
                faults.append(f"{path.name} cannot be read: {error}")
    return faults


def warm(inputs: Path, place: Path) -> dict[str, int]:
    """Import everything and load kernels here, and the peak of each kind's sound run, bytes."""
    (place / "warm").mkdir(parents=True)
    for name in ("ply", "spz", "gsm, state"):
        if command([*KINDS[name].words(inputs, place / "warm"), "--quiet", "--overwrite"]):
            raise SystemExit(f"the sound file of {name} failed")
    for module in ("safetensors.numpy", "torch", "gsmerge.networks.apply", "PIL.Image", "matplotlib", "jinja2"):
        importlib.import_module(module)
    peaks = {}
    for name in KINDS:
        outcome, faults, _ = try_kind(name, inputs, place / "sound", None)
        if faults or outcome.code:
            raise SystemExit(f"the sound file of {name} failed: {faults} {outcome}")
        peaks[name] = outcome.peak
    return peaks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=COUNT, help="inputs over all kinds")
    parser.add_argument("--only", nargs="*", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--case", type=int, help="this one of each kind alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files of the last input")
    parser.add_argument("--table", action="store_true", help="the inputs of tests/hostile in place of generated ones")
    args = parser.parse_args()
    bad = 0
    if args.table:
        with tempfile.TemporaryDirectory() as folder:
            sys.exit(1 if run_table(Path(folder)) else 0)
    with tempfile.TemporaryDirectory() as folder:
        inputs, place = make_inputs(Path(folder) / "inputs"), args.keep or Path(folder) / "place"
        peaks, shares = warm(inputs, Path(folder) / "warm"), sum(KINDS[name].share for name in args.only)
        for name in args.only:
            count = max(1, round(args.count * KINDS[name].share / shares))
            codes, most, slowest = Counter[int](), 0, 0.0
            faulty: defaultdict[str, list[int]] = defaultdict(list)
            for case in range(count) if args.case is None else [args.case]:
                outcome, faults, size = try_kind(name, inputs, place, random.Random(f"{args.seed} {name} {case}"))
                beyond = outcome.peak - peaks[name]
                if beyond > TIMES_INPUT * size + SLACK:
                    faults.append(f"{beyond >> 20} MiB beyond the sound run")
                codes[outcome.code] += 1
                most, slowest = max(most, beyond), max(slowest, outcome.seconds)
                for fault in faults:
                    faulty[fault].append(case)
                if faults or args.case is not None:
                    print(f"  {name} {case}: {faults}: {outcome.err.strip()[-300:]!r}", flush=True)
            bad += sum(len(cases) for cases in faulty.values())
            said = ", ".join(f"{code}: {times}" for code, times in sorted(codes.items()))
            print(
                f"| {name} | {sum(codes.values())} | {said} | {most >> 20} MiB | {slowest:.1f} s |"
                f" {sum(len(cases) for cases in faulty.values())} |", flush=True,
            )  # fmt: skip
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
