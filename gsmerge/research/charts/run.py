"""Running experiments: those that are not done yet, each kept as soon as it is done."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import Any

from gsmerge import __version__
from gsmerge.errors import error_line
from gsmerge.io import AUTO, ReadHints, load_files
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.io.formats.ply_writer import file_bytes
from gsmerge.measure.evaluate import EvaluateOptions, Views, near_plane
from gsmerge.pipeline import compact
from gsmerge.research.charts.experiment import Experiment, run_settings
from gsmerge.research.charts.measure import TargetPlaces, choose_views, held_out, keep_pictures, measure, time_render
from gsmerge.research.charts.places import Place
from gsmerge.research.charts.proxies import measure_proxies, read_proxies, wanted_proxies
from gsmerge.research.charts.record import INPUT, RunRecord
from gsmerge.research.charts.store import append_run, experiment_key, read_runs
from gsmerge.runtime.threads import available_threads, use_threads
from gsmerge.types import PixelScene, UnalignedScene

Progress = Callable[[str, int, int], None]
SCORING = ("score", "input")  # stages of a run that only measure
PACKAGES = ("torch", "numpy", "numba", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class RunOptions:
    """How a grid is run.

    Args:
        lpips: Networks of the perceptual distance; slow.
        lpips_views: Views of each split that get it; None: all.
        seed: Of everything random.
        threads: Threads; None: all processors.
        proxy_views: Photos of each scene whose superpixels alone are measured; 0: none.
        rerun: Do what is done already again.
        command: The command line, for the record.
        hints: What is told of the scenes instead of found.
        opacity: The same of their opacities.
    """

    lpips: tuple[str, ...] = ()
    lpips_views: int | None = None
    seed: int = 0
    threads: int | None = None
    proxy_views: int = 2
    rerun: bool = False
    command: str = ""
    hints: ReadHints = AUTO
    opacity: OpacityChoice = "auto"

    @property
    def evaluation(self) -> EvaluateOptions:
        """What is measured."""
        return EvaluateOptions(lpips=self.lpips, lpips_views=self.lpips_views, threads=self.threads)

    def key_of(self, experiment: Experiment, place: Place) -> str:
        """Of a run with these options."""
        measured: dict[str, Any] = {"lpips": list(self.lpips), "lpips_views": self.lpips_views, "seed": self.seed}
        told = {name: value for name, value in vars(self.hints).items() if value != getattr(AUTO, name)}
        measured |= told if self.opacity == "auto" else {**told, "opacity": self.opacity}
        settings = {**experiment.settings, "measured": measured}
        return experiment_key(place.sha256, experiment.method, settings, experiment.views)


@dataclass(frozen=True)
class Plan:
    """What is to be done.

    Args:
        runs: Experiments, their scenes and keys; one for each key.
        pending: Keys of those that are not done yet, or failed.
        proxies: Segmentation and share by key of the points that are not measured yet, by scene.
        notes: What was left out.
    """

    runs: tuple[tuple[str, Experiment, Place], ...]
    pending: frozenset[str]
    proxies: Mapping[str, Mapping[str, tuple[str, float]]]
    notes: tuple[str, ...]

    @property
    def total(self) -> int:
        """Runs and proxy points that are to be done."""
        return len(self.pending) + sum(map(len, self.proxies.values()))


@dataclass(frozen=True)
class _Ready:
    """A scene that was read."""

    scene: PixelScene | UnalignedScene
    targets: Views | None
    places: TargetPlaces | None
    notes: tuple[str, ...]


def make_plan(
    experiments: Sequence[Experiment], places: Sequence[Place], folder: Path, options: RunOptions
) -> tuple[Plan, dict[str, RunRecord]]:
    """What of a grid is to be done, and the runs that the folder holds already, by key."""
    stored, notes = read_runs(folder)
    done_proxies, more = read_proxies(folder)
    by_path = {place.path: place for place in places}
    runs: dict[str, tuple[str, Experiment, Place]] = {}
    scarce: dict[str, int] = {}
    for experiment in experiments:
        place = by_path[experiment.scene]
        if experiment.views is not None and place.num_views is not None and experiment.views > place.num_views:
            scarce[place.name] = scarce.get(place.name, 0) + 1
            continue
        key = options.key_of(experiment, place)
        runs.setdefault(key, (key, experiment, place))
    told = [f"{name} has fewer views than asked for: {count} run(s) left out" for name, count in scarce.items()]
    pending = {k for k in runs if options.rerun or k not in stored or stored[k].error is not None}
    proxies: dict[str, Mapping[str, tuple[str, float]]] = {}
    for place in places:
        wanted = wanted_proxies(place.sha256, options.proxy_views) if options.proxy_views else {}
        left = {key: point for key, point in wanted.items() if options.rerun or key not in done_proxies}
        proxies |= {place.name: left} if left else {}
    return Plan(tuple(runs.values()), frozenset(pending), proxies, (*notes, *more, *told)), stored


def run_plan(plan: Plan, folder: Path, options: RunOptions, progress: Progress) -> tuple[list[RunRecord], list[str]]:
    """Run what is pending, scene by scene.

    A run that fails is a record that says why, and the others go on.

    Args:
        plan: See :func:`make_plan`.
        folder: The results folder.
        options: How.
        progress: Called with (what, done, total), before each run and after the last.

    Returns:
        The records of the runs that were done, and notes.
    """
    done: list[RunRecord] = []
    notes: list[str] = []
    count = 0

    def step(what: str, add: int = 1) -> None:
        nonlocal count
        progress(what, count, plan.total)
        count += add

    rehearsed: set[tuple[Any, ...]] = set()
    with use_threads(options.threads):
        for place, group in groupby(plan.runs, key=lambda run: run[2]):
            runs = [(key, experiment) for key, experiment, _ in group if key in plan.pending]
            proxies = plan.proxies.get(place.name, {})
            if not runs and not proxies:
                continue
            step(f"{place.name}: reading", 0)
            ready = _read(place, options)
            for key, experiment in runs:
                step(f"{place.name}: {describe(experiment)}")
                blank = _blank(key, experiment, place, options)
                record = _guarded(blank, experiment, ready, folder, options, rehearsed)
                append_run(folder, record)
                done.append(record)
            if isinstance(ready, _Ready) and ready.scene.images is not None and proxies:
                photos, told = ready.scene.images, partial(step, f"{place.name}: superpixels")
                measure_proxies(folder, place.name, photos, proxies, most_views=options.proxy_views, progress=told)
            elif proxies:
                notes.append(f"{place.name}: no photos to measure superpixels on")
                count += len(proxies)
            del ready
    progress("done", plan.total, plan.total)
    return done, notes


def describe(experiment: Experiment) -> str:
    """A run in a few words."""
    told = [f"{name} {value}" for name, value in experiment.settings.items()]
    views = [] if experiment.views is None else [f"{experiment.views} views"]
    return ", ".join([experiment.method, *told, *views])


def _read(place: Place, options: RunOptions) -> _Ready | str:
    """The scene with its targets, or why it cannot be read."""
    try:
        load = load_files(place.files, opacity=options.opacity, hints=options.hints)
        targets, where = held_out(load, place.targets, place.target_images)
        return _Ready(load.scene, targets, where, tuple(load.notes))
    except Exception as error:
        return error_line(error)


def _blank(key: str, experiment: Experiment, place: Place, options: RunOptions) -> RunRecord:
    return RunRecord(
        key=key,
        scene=place.name,
        scene_sha256=place.sha256,
        method=experiment.method,
        settings=dict(experiment.settings),
        views_asked=experiment.views,
        command=options.command,
        environment=environment(options.threads),
    )


def _guarded(
    blank: RunRecord,
    experiment: Experiment,
    ready: _Ready | str,
    folder: Path,
    options: RunOptions,
    rehearsed: set[tuple[Any, ...]],
) -> RunRecord:
    if isinstance(ready, str):
        return replace(blank, error=ready)
    try:
        return run_experiment(blank, experiment, ready, folder, options, rehearsed)
    except Exception as error:  # one bad run must not end the grid; Ctrl-C does
        return replace(blank, error=error_line(error))


def run_experiment(
    blank: RunRecord,
    experiment: Experiment,
    ready: _Ready,
    folder: Path,
    options: RunOptions,
    rehearsed: set[tuple[Any, ...]],
) -> RunRecord:
    """One run: merge, score, time, keep pictures.

    Args:
        blank: The record with what is known before.
        experiment: What to run.
        ready: The scene and its targets.
        folder: The results folder, for pictures.
        options: How.
        rehearsed: Kinds of runs that this process has done before. The first of a kind is tried on two views, so
            that compiling and loading of kernels does not count as its time.
    """
    if experiment.views is not None and experiment.views > len(ready.scene):
        raise ValueError(f"expected at most {len(ready.scene)} views, got {experiment.views}")
    scene, targets = choose_views(ready.scene, ready.targets, ready.places, experiment.views)
    settings = run_settings(experiment.method, experiment.settings) | {"seed": options.seed, "threads": options.threads}
    seconds: dict[str, float] = {}
    notes: tuple[str, ...] = ready.notes
    gaussians = None
    if experiment.method != INPUT:
        kind = (experiment.method, *(experiment.settings.get(name) for name in ("fit", "segmentation", "k")))
        if kind not in rehearsed:
            compact(choose_views(scene, None, None, 2)[0], **settings)
            rehearsed.add(kind)
        result = compact(scene, **settings)
        gaussians, seconds = result.gaussians, result.report.seconds
        notes = (*notes, *result.report.notes)
    scores: dict[str, Any] = {**measure(scene, gaussians, targets, options.evaluation)}
    shown = scene.file_gaussians if gaussians is None else gaussians
    count = scene.num_gaussians if gaussians is None else len(gaussians)
    seen_from = scene.cameras if targets is None else targets.cameras
    return replace(
        blank,
        views=len(scene),
        num_input=scene.num_gaussians,
        count=count,
        ratio=count / max(scene.num_gaussians, 1),
        bytes=file_bytes(count, shown.sh_degree),
        seconds=sum(value for name, value in seconds.items() if name not in SCORING),
        stages=dict(seconds),
        render_ms=time_render(shown, seen_from, near_plane(scene)),
        pictures=keep_pictures(folder, blank.key, blank.scene_sha256, shown, ready.scene, ready.targets),
        notes=notes,
        **scores,
    )


def environment(threads: int | None) -> dict[str, str]:
    """Processor, threads and versions that results and times depend on."""
    found = {
        "gsmerge": __version__,
        "processor": _processor(),
        "threads": str(threads or available_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue  # installed under another name
    return found


def _processor() -> str:
    """Its model, and how many of them there are."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    except OSError:
        pass  # only Linux has it
    return f"{name}, {os.cpu_count() or 1} processors"
