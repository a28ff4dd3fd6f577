"""Execute one run of a grid: merge a scene, or keep it unmerged, measure the result, and save pictures and a record."""

from __future__ import annotations

import math
import os
import platform
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from statistics import median
from types import NoneType
from typing import Any

import cv2
import numpy as np

from gsmerge.batch.records import DONE, FAILED, RECORDS
from gsmerge.compaction.compact import compact
from gsmerge.compaction.left_out import LEAST_VIEWS
from gsmerge.compaction.left_out import choose_views as leave_out_views
from gsmerge.facts.views import even_views, midpoint_views, pick_views, subset
from gsmerge.io.formats.ply import file_bytes
from gsmerge.io.jsonl import each_line
from gsmerge.measure.evaluate import INPUT, EvaluateOptions, evaluate, near_plane
from gsmerge.measure.preview import Picture, heat_map, save_picture, to_picture
from gsmerge.measure.sizes import shrink_cameras
from gsmerge.measure.speed import time_render
from gsmerge.raster import render
from gsmerge.report import document_head
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.content_hash import digest
from gsmerge.scene.files import SceneFiles
from gsmerge.scene.held_out import HeldOutViews, read_held_out
from gsmerge.scene.read import load_files
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Gaussians, Scene, Views
from gsmerge.version import __version__

HELD_OUT = "without --targets no run sees these photos, by which all are judged"
RECORD_VERSION = 2  # version of the records; runs with other versions are run again
SCORING = ("score", "input")  # stages of a run that only measure
MEASURES = ("psnr", "ssim", "lpips_vgg", "lpips_alex")
SCORES = tuple(map("".join, product(MEASURES, ("_context", "_target"), ("", "_visible"))))
PACKAGES = ("torch", "numpy", "cv2")
MAX_TIMED = 4  # most views whose rendering is timed
MAX_PICTURES, MAX_WIDTH, QUALITY = 2, 640, 88  # views of a run with pictures, their width in pixels, JPEG quality
MAX_ERROR = 0.25  # mean absolute error over the channels at the top of the scale of error maps
MAX_DB = 100.0  # PSNR of equal pictures, since JSON has no infinity
_warm_kinds: set[tuple[Any, ...]] = set()  # kinds of runs whose kernels this process has loaded


@dataclass(frozen=True)
class RunRecord:
    """Record of one finished run, successful or not.

    ``scores`` are means over the views of a split, by names such as ``psnr_target_visible``. ``context`` are the views
    that the scene was made of, and ``target`` are held-out views. ``_visible`` counts only pixels that the context
    views see.
    """

    scene: str  # its name
    label: str  # method, settings and number of views in words
    output: str = ""  # name of its files in the folder
    scene_sha256: str = ""  # hash of all files that were read
    method: str = ""  # gsmerge, the name of a baseline, or input (the scene as it is)
    settings: Mapping[str, Any] = field(default_factory=dict)  # settings by flat name; the rest have defaults
    views_asked: int | None = None  # requested number of views; None: all
    command: str = ""  # the command line of the run
    environment: Mapping[str, str] = field(default_factory=dict)  # processor, threads and versions
    views: int | None = None  # number of input views
    num_input: int | None = None  # number of Gaussians of those views
    count: int | None = None  # number of Gaussians of the result
    bytes: int | None = None  # size of the result as a .ply
    seconds: float | None = None  # wall time of the merge, without reading, writing and scoring
    stages: Mapping[str, float] = field(default_factory=dict)  # wall time of each stage, including scoring
    render_ms: float | None = None  # median time of rendering a view, milliseconds
    scores: Mapping[str, float] = field(default_factory=dict)
    pictures: tuple[str, ...] = ()  # names of the views whose pictures were saved
    notes: tuple[str, ...] = ()  # notes of the reader and of the run
    error: str | None = None  # reason of a failure, in one line; None if the run succeeded
    record_version: int = RECORD_VERSION

    @property
    def ratio(self) -> float | None:
        """Share of the input's Gaussians that the result keeps."""
        return None if self.count is None or self.num_input is None else self.count / max(self.num_input, 1)

    @property
    def percent(self) -> float | None:
        """Percentage of the input's Gaussians that the result keeps."""
        return None if self.ratio is None else 100 * self.ratio

    def value(self, name: str) -> float | None:
        """Return a score or a numeric field by name; None if it was not measured."""
        return self.scores.get(name) if name in SCORES else getattr(self, name)

    def to_dict(self) -> dict[str, Any]:
        """Convert the record to plain JSON types, with each score under its own name."""
        return {**asdict(self), "ratio": self.ratio, **{name: self.value(name) for name in SCORES}}


def _is_number(value: object) -> bool:
    """Return True for a finite number from JSON, but not for a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_valid(name: str, value: Any) -> bool:
    """Return True if a value from JSON has the type of its field."""
    default = getattr(BLANK, name)
    if isinstance(default, Mapping):
        words = () if name in ("stages", "scores") else (str, bool, NoneType)
        return isinstance(value, dict) and all(_is_number(item) or isinstance(item, words) for item in value.values())
    if isinstance(default, tuple):
        return isinstance(value, list) and all(isinstance(item, str) for item in value)
    return isinstance(value, str) if isinstance(default, str) else value is None or _is_number(value)


BLANK = RunRecord("", "")


def read_runs(folder: Path) -> tuple[list[RunRecord], list[str]]:
    """Read the newest record of each run in a folder; also return notes on records left out.

    Records of other versions, and of scenes whose files have changed since, are skipped.
    """
    newest: dict[str, RunRecord | None] = {}
    for _, line in each_line(folder / RECORDS):
        if line is not None and isinstance(output := line.get("output"), str):
            newest.pop(output, None)  # a repeated run moves to the end
            newest[output] = _read_record(line)
    records = [record for record in newest.values() if record is not None]
    hashes = {record.scene: record.scene_sha256 for record in records if record.error is None}
    current = [record for record in records if record.error is not None or record.scene_sha256 == hashes[record.scene]]
    num_foreign, num_outdated = len(newest) - len(records), len(records) - len(current)
    notes = []
    if num_foreign:
        notes.append(f"{folder}: {num_foreign} record(s) of another version or kind were passed over")
    if num_outdated:
        notes.append(f"{num_outdated} run(s) left out, which read other files than the last one of their scene")
    return current, notes


def _read_record(record: Mapping[str, Any]) -> RunRecord | None:
    """Read a run from the record of a batch; None for other versions or kinds of records."""
    scene, _, label = record["output"].rpartition("/")
    if record.get("status") == FAILED:
        return RunRecord(scene, label, error=str(record.get("error") or "unknown"))
    report, names = record.get("report"), [f.name for f in fields(RunRecord)]
    run = report.get("run") if isinstance(report, dict) and record.get("status") == DONE else None
    if not isinstance(run, dict) or not all(name in run and _is_valid(name, run[name]) for name in names):
        return None
    if run["record_version"] != RECORD_VERSION or run["error"] is not None:
        return None
    lists = {name: tuple(run[name]) for name in ("pictures", "notes")}
    return RunRecord(**{**{name: run[name] for name in names}, **lists})


def picture_path(folder: Path, output: str, view: int, kind: str) -> Path:
    """Return the path of a picture of a run or, with the output ``SCENE/photo``, of a scene; ``kind`` is its type."""
    return folder / f"{output}.{view}.{kind}.{'png' if kind == 'error' else 'jpg'}"


def describe(method: str, settings: Mapping[str, Any], views: int | None) -> str:
    """Describe a run in a few words: method, settings, number of views."""
    words = [f"{name} {value}" for name, value in settings.items()]
    return ", ".join([method, *words, *([] if views is None else [f"{views} views"])])


@dataclass(frozen=True)
class ChartRun:
    """Run and measurement of one grid point on one scene; see :class:`gsmerge.batch.jobs.SceneCall`."""

    record: RunRecord  # values that are known before the run
    settings: CompactOptions  # all settings
    measured: EvaluateOptions  # settings of the measurements
    targets: Path | None = None  # cameras of held-out views
    target_images: Path | None = None  # folder of their photos; None: found by their cameras

    def key(self, files: SceneFiles) -> str:
        """Return a hash of everything that the measurements depend on; the record has the hash of the files."""
        run = asdict(replace(self.record, command=""))
        conditions = {"measured": asdict(self.measured), "seed": self.settings.seed, "tool_version": __version__}
        return digest({"run": run, **conditions})

    def run(self, files: SceneFiles, out: Path, threads: int) -> tuple[dict[str, Any], list[Path]]:
        """Merge, score and time a scene, and save pictures; return a batch record's report and the picture files."""
        with use_threads(threads):
            scene, held_out, notes = _load(files, self.targets, self.target_images, self.record.scene_sha256)
            facts, pictures = self._measure(scene, held_out, out, threads)
        facts["notes"] = (*notes, *facts.get("notes", ()))
        record = replace(self.record, environment=environment(threads), **facts)
        return {**document_head(), "notes": list(record.notes), "run": asdict(record)}, pictures

    def _measure(
        self, scene: Scene, held_out: HeldOutViews | None, out: Path, threads: int
    ) -> tuple[dict[str, Any], list[Path]]:
        """Merge the requested views and measure the result; return fields of the record, and the picture files."""
        is_input, num_views = self.record.method == INPUT, self.record.views_asked
        if num_views is not None and num_views > len(scene):
            raise ValueError(f"expected at most {len(scene)} views, got {num_views}")
        part, targets = choose_views(scene, held_out, num_views)
        facts: dict[str, Any] = {"seconds": 0.0}
        gaussians = part.file_gaussians
        if not is_input:
            self._warm_up(scene, threads)
            gaussians, facts = self._merge(part, threads)
        options = replace(self.measured, threads=threads)
        cameras, near = part.cameras if targets is None else targets.cameras, near_plane(part)
        cameras = shrink_cameras(cameras, options.photo_side)
        timed = pick_views(len(cameras), MAX_TIMED)
        pictures, names = keep_pictures(out, gaussians, scene, held_out)
        facts |= {
            "views": len(part),
            "num_input": part.num_gaussians,
            "count": len(gaussians),
            "bytes": file_bytes(len(gaussians), gaussians.sh_degree),
            "scores": measure(part, None if is_input else gaussians, targets, options),
            "render_ms": 1000 * median(time_render(gaussians, cameras[[view]], near) for view in timed),
            "pictures": names,
        }
        return facts, pictures

    def _warm_up(self, scene: Scene, threads: int) -> None:
        """Run once on two views, so that the measured time excludes the loading of kernels."""
        kind = (self.record.method, *(self.record.settings.get(name) for name in ("fit", "segmentation", "k")))
        if kind not in _warm_kinds:
            compact(choose_views(scene, None, 2)[0], replace(self.settings, threads=threads))
            _warm_kinds.add(kind)

    def _merge(self, scene: Scene, threads: int) -> tuple[Gaussians, dict[str, Any]]:
        """Merge a scene; return the Gaussians, and times and notes as fields of the record."""
        result = compact(scene, replace(self.settings, threads=threads))
        stages = result.report.seconds
        seconds = sum(time for name, time in stages.items() if name not in SCORING)
        return result.gaussians, {"seconds": seconds, "stages": dict(stages), "notes": tuple(result.report.notes)}


@lru_cache(maxsize=1)
def _load(
    files: SceneFiles, targets: Path | None, target_images: Path | None, sha256: str
) -> tuple[Scene, HeldOutViews | None, tuple[str, ...]]:
    """Read a scene with its held-out views, once for consecutive runs; ``sha256`` is the hash of the files."""
    load = load_files(files)
    if targets is not None:
        return load.scene, read_held_out(load, targets, target_images), tuple(load.notes)
    scene, held_out = hold_out(load.scene)
    if held_out is None:
        return scene, None, tuple(load.notes)
    names = ", ".join(held_out.names)
    return scene, held_out, (*load.notes, f"{HELD_OUT}: {names}")


def list_held_out_notes(records: Iterable[RunRecord]) -> list[str]:
    """List a note for each scene without targets; it names the held-out photos on which the scene's runs are scored."""
    notes = (f"{record.scene}: {note}" for record in records for note in record.notes if note.startswith(HELD_OUT))
    return list(dict.fromkeys(notes))


def hold_out(scene: Scene) -> tuple[Scene, HeldOutViews | None]:
    """Hold out some photos of a scene to score its results on; none of fewer than four photos."""
    photos = scene.photo_views
    if len(photos) < LEAST_VIEWS or scene.images is None:
        return scene, None
    ids, _ = leave_out_views(photos)
    rest = [view for view in range(len(scene)) if view not in ids]
    names = tuple(scene.names[view] for view in ids)
    held_out = HeldOutViews(scene.cameras[ids], scene.images[ids], names, tuple(ids), tuple(rest))
    return subset(scene, rest), held_out


def choose_views(scene: Scene, held_out: HeldOutViews | None, count: int | None) -> tuple[Scene, Views | None]:
    """Choose ``count`` evenly spread views of a scene, and held-out views near the middle between two chosen views.

    Without ``count`` all views are chosen. If the order of views along the trajectory is unknown, all held-out views
    are chosen.
    """
    if count is None or count >= len(scene):
        return scene, held_out
    ids = even_views(len(scene), count)
    if held_out is None or held_out.context_places is None:
        return subset(scene, ids), held_out
    midpoints = midpoint_views([held_out.context_places[i] for i in ids], held_out.places)
    return subset(scene, ids), held_out[midpoints] if midpoints else None


def measure(
    scene: Scene, gaussians: Gaussians | None, targets: Views | None, options: EvaluateOptions
) -> dict[str, float]:
    """Measure mean scores by name (``psnr_target_visible``, ...); names without a measurement are left out.

    Without ``gaussians`` the scene's own Gaussians are measured.
    """
    results = {} if gaussians is None else {"result": gaussians}
    evaluation = evaluate(scene, results, targets, replace(options, own=gaussians is None, fog=False))
    scores: dict[str, float] = {}
    for split in evaluation.num_views:
        full, masked = evaluation.results[-1].mean(split)
        for part, quality in (("", full), ("_visible", masked)):
            for name, value in asdict(quality).items():
                if value is not None and not math.isnan(value):
                    scores[f"{name}_{split}{part}"] = min(value, MAX_DB)
    return scores


def keep_pictures(
    out: Path, gaussians: Gaussians, scene: Scene, held_out: HeldOutViews | None
) -> tuple[list[Path], tuple[str, ...]]:
    """Write renders and error maps of a few views, and the photos.

    Returns the paths of renders and error maps, and the names of the views. The views are held-out views or, without
    any, views of the scene. ``scene`` and ``held_out`` have all views, so that all runs of a scene have pictures of the
    same views.
    """
    views = scene if held_out is None else held_out
    photos, names = views.images, views.names
    ids, near = pick_views(len(names), MAX_PICTURES), near_plane(scene)
    paths = []
    for i, view in enumerate(ids):
        image = render(gaussians, views.cameras[[view]], near=near).images[0].clip(0, 1)
        paths.append(picture_path(out.parent, out.name, i, "render"))
        _write(paths[-1], to_picture(image))
        if photos is not None:
            _write(picture_path(out.parent, "photo", i, "photo"), to_picture(photos[view]))
            paths.append(picture_path(out.parent, out.name, i, "error"))
            _write(paths[-1], heat_map((np.abs(image - photos[view]).mean(2) / MAX_ERROR).clip(0, 1)))
    return paths, tuple(names[view] for view in ids)


def _write(path: Path, picture: Picture) -> None:
    """Write a picture, reduced to ``MAX_WIDTH``."""
    height, width = picture.shape[:2]
    if width > MAX_WIDTH:
        size = MAX_WIDTH, max(1, round(height * MAX_WIDTH / width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    save_picture(path, picture, *((cv2.IMWRITE_JPEG_QUALITY, QUALITY) if path.suffix == ".jpg" else ()))


def environment(threads: int) -> dict[str, str]:
    """Return processor, threads and versions, which affect results and times."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:  # only Linux has it
        models = (line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
        processor = next(models, processor)
    versions = {name: sys.modules[name].__version__ for name in PACKAGES if sys.modules.get(name)}
    return {
        "gsmerge": __version__,
        "processor": f"{processor}, {os.cpu_count() or 1} processors",
        "threads": str(threads),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }
