"""Planning and running experiments: those that are not done yet, each stored as soon as it is done."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import Any

from gsmerge import __version__
from gsmerge.errors import error_line
from gsmerge.io import AUTO, HeldOutViews, ReadHints, load_files, read_held_out
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.io.formats.writing import file_bytes
from gsmerge.measure.evaluate import EvaluateOptions, near_plane
from gsmerge.measure.speed import time_render
from gsmerge.options import CompactOptions
from gsmerge.pipeline import compact
from gsmerge.plan import resolve_fit, resolved_settings
from gsmerge.research.charts.experiment import Experiment, run_settings
from gsmerge.research.charts.measure import choose_views, keep_pictures, measure
from gsmerge.research.charts.proxies import measure_proxies, proxy_points, read_proxies
from gsmerge.research.charts.record import INPUT, RunRecord, append_run, experiment_key, read_runs
from gsmerge.research.charts.scenes import SceneSource
from gsmerge.runtime.estimate import work_seconds
from gsmerge.runtime.threads import available_threads, use_threads
from gsmerge.types import Scene
from gsmerge.views import pick_views

Progress = Callable[[str, int, int], None]
SCORING = ("score", "input")  # stages of a run that only measure
PACKAGES = ("torch", "numpy", "numba", "opencv-contrib-python-headless")
BYTES_PER_GAUSSIAN = 68  # of a .ply without higher harmonics
MAX_TIMED = 4  # views that are rendered for the time
COST_EVALUATE = 2.5  # seconds per million pixels of all views, to score input and result
COST_LPIPS = 12.0  # the same for each network


@dataclass(frozen=True)
class RunOptions:
    """How a grid is run."""

    lpips: tuple[str, ...] = ()  # networks of the perceptual distance; slow
    lpips_views: int | None = None  # views of each split that are measured with them; None: all
    seed: int = 0  # seed of all random numbers
    threads: int | None = None  # threads; None: all processors
    proxy_views: int = 2  # photos of each scene whose superpixels alone are measured; 0: none
    rerun: bool = False  # repeat what is done already
    command: str = ""  # the command line, for the record
    hints: ReadHints = AUTO  # facts about the scenes that are given instead of detected
    opacity: OpacityChoice = "auto"  # the same of their opacities

    def key_of(self, experiment: Experiment, source: SceneSource) -> str:
        """Key of a run with these options."""
        measured: dict[str, Any] = {"lpips": list(self.lpips), "lpips_views": self.lpips_views, "seed": self.seed}
        measured |= {name: value for name, value in vars(self.hints).items() if value != getattr(AUTO, name)}
        measured |= {} if self.opacity == "auto" else {"opacity": self.opacity}
        settings = {**experiment.settings, "measured": measured}
        return experiment_key(source.sha256, experiment.method, settings, experiment.views)


@dataclass(frozen=True)
class Plan:
    """The runs of a grid, and which of them are still to be done."""

    runs: tuple[tuple[str, Experiment, SceneSource], ...]  # key, experiment and scene of every run; one for each key
    pending: frozenset[str]  # keys of the runs that are not done yet, or failed
    # segmentation and share by key of the proxy points that are not measured yet, by scene
    proxies: Mapping[str, Mapping[str, tuple[str, float]]]
    notes: tuple[str, ...]  # what was left out

    @property
    def total(self) -> int:
        """Runs and proxy points that are to be done."""
        return len(self.pending) + sum(map(len, self.proxies.values()))


@dataclass(frozen=True)
class _LoadedScene:
    """A scene in memory with its held-out views."""

    scene: Scene
    held_out: HeldOutViews | None
    notes: tuple[str, ...]


def make_plan(
    experiments: Sequence[Experiment], sources: Sequence[SceneSource], folder: Path, options: RunOptions
) -> tuple[Plan, dict[str, RunRecord]]:
    """The plan of a grid, and the runs that the folder holds already, by key."""
    stored, notes = read_runs(folder)
    done_proxies, more = read_proxies(folder)
    by_path = {source.path: source for source in sources}
    runs: dict[str, tuple[str, Experiment, SceneSource]] = {}
    too_few: Counter[str] = Counter()
    for experiment in experiments:
        source = by_path[experiment.scene]
        if experiment.views is not None and source.num_views is not None and experiment.views > source.num_views:
            too_few[source.name] += 1
        else:
            key = options.key_of(experiment, source)
            runs.setdefault(key, (key, experiment, source))
    skipped = [f"{name} has fewer views than asked for: {count} run(s) left out" for name, count in too_few.items()]
    pending = {k for k in runs if options.rerun or k not in stored or stored[k].error is not None}
    proxies: dict[str, Mapping[str, tuple[str, float]]] = {}
    for source in sources:
        points = proxy_points(source.sha256, options.proxy_views) if options.proxy_views else {}
        left = {key: point for key, point in points.items() if options.rerun or key not in done_proxies}
        proxies |= {source.name: left} if left else {}
    return Plan(tuple(runs.values()), frozenset(pending), proxies, (*notes, *more, *skipped)), stored


def run_plan(plan: Plan, folder: Path, options: RunOptions, progress: Progress) -> tuple[list[RunRecord], list[str]]:
    """Run what is pending, scene by scene; returns the records of what was run, and notes.

    A run that fails gives a record with the reason, and the others go on. ``progress`` is called with (step, done,
    total) before each run and after the last.
    """
    done: list[RunRecord] = []
    notes: list[str] = []
    count = 0

    def step(text: str, add: int = 1) -> None:
        nonlocal count
        progress(text, count, plan.total)
        count += add

    warm: set[tuple[Any, ...]] = set()
    with use_threads(options.threads):
        for source, group in groupby(plan.runs, key=lambda run: run[2]):
            runs = [(key, experiment) for key, experiment, _ in group if key in plan.pending]
            proxies = plan.proxies.get(source.name, {})
            if not runs and not proxies:
                continue
            step(f"{source.name}: reading", 0)
            loaded = _read(source, options)
            for key, experiment in runs:
                step(f"{source.name}: {describe(experiment)}")
                record = _start_record(key, source, experiment, options)
                try:
                    record = _run(record, loaded, folder, options, warm)
                except Exception as error:  # one bad run must not end the grid; Ctrl-C does
                    record = replace(record, error=error_line(error))
                append_run(folder, record)
                done.append(record)
            if proxies and isinstance(loaded, _LoadedScene) and loaded.scene.images is not None:
                photos, report = loaded.scene.images, partial(step, f"{source.name}: superpixels")
                measure_proxies(folder, source.name, photos, proxies, max_views=options.proxy_views, progress=report)
            elif proxies:
                notes.append(f"{source.name}: no photos to measure superpixels on")
                count += len(proxies)
            del loaded
    progress("done", plan.total, plan.total)
    return done, notes


def describe(run: Experiment | RunRecord) -> str:
    """A run in a few words."""
    settings = [f"{name} {value}" for name, value in run.settings.items()]
    count = run.views if isinstance(run, Experiment) else run.views_asked
    return ", ".join([run.method, *settings, *([] if count is None else [f"{count} views"])])


def _read(source: SceneSource, options: RunOptions) -> _LoadedScene | Exception:
    """The scene with its held-out views, or why it cannot be read."""
    try:
        load = load_files(source.files, opacity=options.opacity, hints=options.hints)
        held_out = None if source.targets is None else read_held_out(load, source.targets, source.target_images)
        return _LoadedScene(load.scene, held_out, tuple(load.notes))
    except Exception as error:
        return error


def _start_record(key: str, source: SceneSource, experiment: Experiment, options: RunOptions) -> RunRecord:
    """What is known of a run beforehand."""
    return RunRecord(
        key=key,
        scene=source.name,
        scene_sha256=source.sha256,
        method=experiment.method,
        settings=dict(experiment.settings),
        views_asked=experiment.views,
        command=options.command,
        environment=environment(options.threads),
    )


def _run(
    record: RunRecord, loaded: _LoadedScene | Exception, folder: Path, options: RunOptions, warm: set[tuple[Any, ...]]
) -> RunRecord:
    """Merge, score, time, store pictures.

    ``warm`` has the kinds of runs that this process has done before, and is added to. The first of a kind is tried on
    two views, so that compiling and loading of kernels does not count as its time.
    """
    if isinstance(loaded, Exception):
        raise loaded
    if record.views_asked is not None and record.views_asked > len(loaded.scene):
        raise ValueError(f"expected at most {len(loaded.scene)} views, got {record.views_asked}")
    scene, targets = choose_views(loaded.scene, loaded.held_out, record.views_asked)
    settings = run_settings(record.method, record.settings) | {"seed": options.seed, "threads": options.threads}
    seconds: dict[str, float] = {}
    notes: tuple[str, ...] = loaded.notes
    result = None
    if record.method != INPUT:
        kind = (record.method, *(record.settings.get(name) for name in ("fit", "segmentation", "k")))
        if kind not in warm:
            compact(choose_views(scene, None, 2)[0], **settings)
            warm.add(kind)
        done = compact(scene, **settings)
        result, seconds = done.gaussians, done.report.seconds
        notes = (*notes, *done.report.notes)
    evaluation = EvaluateOptions(lpips=options.lpips, lpips_views=options.lpips_views, threads=options.threads)
    scores: dict[str, Any] = {**measure(scene, result, targets, evaluation)}
    gaussians = scene.file_gaussians if result is None else result
    count = scene.num_gaussians if result is None else len(result)
    cameras, near = scene.cameras if targets is None else targets.cameras, near_plane(scene)
    views = pick_views(len(cameras), MAX_TIMED)
    return replace(
        record,
        views=len(scene),
        num_input=scene.num_gaussians,
        count=count,
        ratio=count / max(scene.num_gaussians, 1),
        bytes=file_bytes(count, gaussians.sh_degree),
        seconds=sum(value for name, value in seconds.items() if name not in SCORING),
        stages=dict(seconds),
        render_ms=1000 * median(time_render(gaussians, cameras[[view]], near) for view in views),
        pictures=keep_pictures(folder, record.key, record.scene_sha256, gaussians, loaded.scene, loaded.held_out),
        notes=notes,
        **scores,
    )


def estimate_seconds(
    runs: Sequence[tuple[str, Experiment, SceneSource]], stored: Mapping[str, RunRecord], options: RunOptions
) -> float:
    """Wall time of runs, within a factor of about two; from times of the same scene and method in ``stored`` if any."""
    threads = options.threads or available_threads()
    known: dict[tuple[str, str], list[float]] = {}
    for record in stored.values():
        if record.seconds is not None and record.error is None:
            known.setdefault((record.scene, record.method), []).append(record.seconds)
    total = 0.0
    for _, experiment, source in runs:
        views = source.num_views or 1
        share = min(1.0, (experiment.views or views) / views)
        gaussians = share * source.files.ply.stat().st_size / BYTES_PER_GAUSSIAN
        lpips_share = min(1.0, (options.lpips_views or views) / max(share * views, 1.0))
        total += gaussians / 1e6 * (COST_EVALUATE + lpips_share * COST_LPIPS * len(options.lpips)) / threads
        times = known.get((source.name, experiment.method))
        if times:
            total += share * median(times)
        elif experiment.method != INPUT:
            settings = CompactOptions().with_settings(run_settings(experiment.method, experiment.settings))
            flat, steps, of_view = (
                resolved_settings(settings, photos=True),
                resolve_fit(settings).steps,
                gaussians / max(share * views, 1),
            )
            total += work_seconds(round(gaussians), of_view, flat, photos=True, fit_steps=steps) / threads
    return total


def environment(threads: int | None) -> dict[str, str]:
    """Processor, threads and versions that results and times depend on."""
    values = {
        "gsmerge": __version__,
        "processor": _processor(),
        "threads": str(threads or available_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    for name in PACKAGES:
        with suppress(PackageNotFoundError):  # installed under another name
            values[name] = version(name)
    return values


def _processor() -> str:
    """Its model, and the number of processors."""
    name = platform.processor() or platform.machine()
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:  # only Linux has it
        name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    return f"{name}, {os.cpu_count() or 1} processors"
