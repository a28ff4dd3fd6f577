"""Run one setting of a grid on a scene, and score the result; the records of runs are lines of a JSON file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from gsmerge.frozen import asdict, dataclass, field, replace
from gsmerge.io.formats.ply import file_bytes
from gsmerge.io.jsonl import each_line
from gsmerge.method.facts.prepared import LEAST_VIEWS
from gsmerge.method.geometry.views import subset
from gsmerge.reading.held_out import HeldOutViews, read_held_out
from gsmerge.reading.read_scene import read_files
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.results.left_out import choose_left_out
from gsmerge.run import compact
from gsmerge.scoring.evaluate import INPUT, EvaluateOptions, evaluate
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Scene

RUNS = "runs.jsonl"  # in the folder of a grid
SCORING = ("score", "input")  # stages of a run that only measure


@dataclass(frozen=True)
class ChartScene:
    """A scene of a grid, which is not yet read."""

    path: Path  # the ``.ply``, or its folder
    name: str  # short name, unique in a grid
    targets: Path | None  # cameras of held-out views
    sha256: str  # hash of all files of the scene and of its held-out views


@dataclass(frozen=True)
class RunRecord:
    """Record of one run, successful or not.

    ``scores`` are means over views. The name of a score is made of a metric, "context" for the views that the scene was
    made of or "target" for held-out views, and "visible" if only pixels that context views see are counted. An example
    is ``psnr_target_visible``.
    """

    scene: str  # its name
    label: str  # method and settings in words
    key: str  # hash of everything that the measurements depend on
    method: str  # gsmerge, the name of a baseline, or input (the scene as it is)
    settings: Mapping[str, Any]  # settings by flat name; the rest have defaults
    num_input: int = 0  # number of Gaussians of the scene
    count: int = 0  # number of Gaussians of the result
    bytes: int = 0  # size of the result as a .ply
    seconds: float = 0.0  # wall time of the merge, without reading, writing and scoring
    scores: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # notes of the reader and of the run
    held_out: tuple[str, ...] = ()  # photos that were hidden from the run to score it, as the scene has no targets
    error: str | None = None  # reason of a failure, in one line; None if the run succeeded

    @property
    def percent(self) -> float:
        """Percentage of the input's Gaussians that the result keeps."""
        return 100 * self.count / max(self.num_input, 1)

    def value(self, name: str) -> float | None:
        """Return a score or a number by name, or None if it was not measured."""
        return getattr(self, name) if name in ("count", "bytes", "seconds", "percent") else self.scores.get(name)


def describe_run(method: str, settings: Mapping[str, Any]) -> str:
    """Describe a run in a few words: method and settings."""
    return ", ".join([method, *(f"{name} {value}" for name, value in settings.items())])


def read_runs(folder: Path) -> list[RunRecord]:
    """Read the newest record of each run in a folder; skip damaged lines, and lines of other versions."""
    runs: dict[tuple[str, str], RunRecord] = {}
    for _, line in each_line(folder / RUNS):
        if line is not None and line.keys() == RunRecord.__dataclass_fields__.keys():
            runs[line["scene"], line["label"]] = RunRecord(
                **{**line, "notes": tuple(line["notes"]), "held_out": tuple(line["held_out"])}
            )
    return list(runs.values())


def run_setting(source: ChartScene, record: RunRecord, options: CompactOptions, measured: EvaluateOptions) -> RunRecord:
    """Merge a scene, measure the result, and return the completed record.

    ``record`` names the scene, the method and the settings. If the method is ``INPUT``, the scene itself is measured.
    """
    scene, held_out, notes = load_source(source)
    if record.method == INPUT:
        gaussians = scene.file_gaussians
        seconds = 0.0
    else:
        result = compact(scene, options)
        gaussians = result.gaussians
        notes = (*notes, *result.report.notes)
        seconds = sum(time for name, time in result.report.seconds.items() if name not in SCORING)
    # Means by name (``psnr_target_visible``, ...); names without a measurement are left out
    results = {} if record.method == INPUT else {"result": gaussians}
    evaluation = evaluate(scene, results, held_out, replace(measured, own=record.method == INPUT, fog=False))
    scores: dict[str, float] = {}
    max_db = 100.0  # PSNR of equal pictures, since JSON has no infinity
    for split in evaluation.num_views:
        full, masked = evaluation.results[-1].mean(split)
        for part, quality in (("", full), ("_visible", masked)):
            for name, value in asdict(quality).items():
                if value is not None and not math.isnan(value):
                    scores[f"{name}_{split}{part}"] = min(value, max_db)
    return replace(
        record,
        num_input=scene.num_gaussians,
        count=len(gaussians),
        bytes=file_bytes(len(gaussians), gaussians.sh_degree),
        seconds=seconds,
        scores=scores,
        notes=notes,
        held_out=() if held_out is None or source.targets is not None else held_out.names,
    )


@lru_cache(maxsize=1)
def load_source(source: ChartScene) -> tuple[Scene, HeldOutViews | None, tuple[str, ...]]:
    """Return a scene, its held-out views, and notes; all three are cached, since the next run often has the same scene.

    The held-out views are read from ``source.targets``. Without targets, some views are taken out of the scene.
    """
    load = read_files(find_scene_files(source.path))
    if source.targets is not None:
        return load.scene, read_held_out(load, source.targets), load.notes
    return *hold_out(load.scene), load.notes


def hold_out(scene: Scene) -> tuple[Scene, HeldOutViews | None]:
    """Hold out some photos of a scene to score its results on; return the scene without them, and the held-out views.

    A scene with fewer than four photos keeps all of them.
    """
    photos = scene.photo_views
    if len(photos) < LEAST_VIEWS or scene.images is None:
        return scene, None
    ids, _ = choose_left_out(photos)
    rest = [view for view in range(len(scene)) if view not in ids]
    names = tuple(scene.names[view] for view in ids)
    return subset(scene, rest), HeldOutViews(scene.cameras[ids], scene.images[ids], names, tuple(ids), tuple(rest))
