"""Make the jobs of a batch from a grid of settings. Every combination of the listed values runs on every scene."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal

from gsmerge.batch.find import find_scenes, main_file, scene_plys
from gsmerge.batch.jobs import Job
from gsmerge.errors import SceneError, UsageError
from gsmerge.io.cameras.read import find_cameras
from gsmerge.io.cameras.table import is_colmap
from gsmerge.io.formats.table import estimate_counts
from gsmerge.measure.evaluate import EvaluateOptions
from gsmerge.research.charts.lines import ONE_SIZE, SIZES
from gsmerge.research.charts.measure_run import INPUT, ChartRun, RunRecord, describe
from gsmerge.scene.content_hash import (
    content_hash,
    digest,
    fill_template,
    list_files,
    list_photos,
    scene_name,
    try_cameras,
)
from gsmerge.scene.files import find_scene_files
from gsmerge.settings.compact import OURS, RECIPES, CompactOptions
from gsmerge.settings.setting import Settings, join_words, setting, settings_of

ALL = "all"  # word for all views
FITTED = {"unmerged-fit": ("effort",)}  # settings of gsmerge that also apply to a baseline
NUMBERS = ("k", "budget", "superpixels", "views")  # lists whose values may be numbers
SETTINGS = ("k", "segmentation", "fit", "effort", "match")  # lists that are combined; the lists of SIZES are joined
MAX_NAME = 100  # most characters of a run in names of files


@dataclass(frozen=True)
class SettingsGrid(Settings):
    """Lists of values for settings; every combination is run. Other settings come from the defaults or a recipe."""

    method: tuple[str, ...] = setting((OURS,), "Methods: gsmerge and baselines.", filled=True, unique=True)
    k: tuple[int, ...] = setting((), "Gaussians per superpixel: 1 to 8.", unique=True)
    budget: tuple[int | str, ...] = setting((), "Gaussians in the result, such as 0.5%,2%,40000,auto.", unique=True)
    superpixels: tuple[int | str, ...] = setting((), "Superpixels per view, such as 3000,4.4%, next to the budgets.",
        unique=True)  # fmt: skip
    segmentation: tuple[str, ...] = setting((), "Superpixel methods.", unique=True)
    fit: tuple[str, ...] = setting((), "Kind of fit: full, none.", unique=True)
    effort: tuple[str, ...] = setting((), "Amount of work: draft, fast, default, best.", unique=True)
    match: tuple[str, ...] = setting((), "Merging across views: overlap, aabb, none.", unique=True)
    views: tuple[int | Literal["all"], ...] = setting((ALL,), "Numbers of input views, evenly spread; all for all.",
        least=1, filled=True, unique=True)  # fmt: skip
    fixed: Mapping[str, Any] = field(default_factory=dict)  # other settings of compact for all runs of gsmerge

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*SETTINGS, *SIZES, "method"):
            if name in self.fixed and (name == "method" or getattr(self, name)):
                raise UsageError(f"--set {name}: expected another setting, use --grid {name}=A,B")


def parse_grid(pairs: Sequence[str], fixed: Mapping[str, Any] | None = None) -> SettingsGrid:
    """Make a grid from pairs NAME=A,B with names of :class:`SettingsGrid`; UsageError for impossible values."""
    values: dict[str, tuple[Any, ...]] = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        names = settings_of(SettingsGrid)
        if name not in names:
            raise UsageError(f"--grid {name}: expected {join_words(names)} before =, and values with commas between")
        if name in values:
            raise UsageError(f"--grid {name}: expected it once, got it twice")
        parts = [part.strip() for part in text.split(",") if part.strip()]
        if not parts:
            raise UsageError(f"--grid {name}: expected at least one value, got none")
        values[name] = tuple(int(part) if name in NUMBERS and part.isdecimal() else part for part in parts)
    try:
        return SettingsGrid(**values, fixed=fixed or {})
    except ValueError as error:
        raise UsageError(str(error)) from error


def list_settings(grid: SettingsGrid) -> tuple[list[tuple[str, dict[str, Any]]], list[str]]:
    """List (method, settings) of every run on one scene, the unmerged input first; also notes on combinations left out.

    Only settings that differ from the defaults are listed. A fixed recipe replaces the defaults of gsmerge, and lists
    take precedence over the recipe. Baselines lack most settings. They run once per size, or once if they keep all
    Gaussians.
    """
    sizes: list[dict[str, Any]] = [{name: size} for name in SIZES for size in getattr(grid, name)]
    lists, fixed = [getattr(grid, name) or (None,) for name in SETTINGS], grid.fixed
    defaults = CompactOptions().to_dict()
    recipe_defaults = {**defaults, **RECIPES.get(str(fixed.get("recipe")), {})}
    runs = {describe(INPUT, {}, None): (INPUT, dict[str, Any]())}
    repeated = 0
    for method, *values, size in product(grid.method, *lists, sizes or [{}]):
        names, usual = (SETTINGS, recipe_defaults) if method == OURS else (FITTED.get(method, ()), defaults)
        settings = {} if method in (INPUT, *ONE_SIZE) else dict(size)
        listed = zip(SETTINGS, values, strict=True)
        settings |= {name: value for name, value in listed if name in names and value not in (None, usual[name])}
        settings |= fixed if method == OURS else {}
        label = describe(method, settings, None)
        repeated += label in runs
        runs.setdefault(label, (method, settings))
    notes = [f"{repeated} combination(s) left out: their method does not use the settings that differ"]
    return list(runs.values()), notes if repeated else []


def _options_of(method: str, settings: Mapping[str, Any], seed: int) -> CompactOptions:
    """Make the options of a run; raise UsageError if a setting is invalid or a program is missing."""
    from gsmerge.compaction.methods import find_method

    choice = {} if method in (OURS, INPUT) else {"method": method}
    try:
        options = CompactOptions().with_settings({"fill": True, **settings, **choice, "seed": seed})  # counts as asked
    except ValueError as error:
        raise UsageError(str(error)) from error
    find_method(options)
    return options


@dataclass(frozen=True)
class ChartScene:
    """A scene to run, before it is read."""

    path: Path  # the ``.ply``, or its folder
    name: str  # short name, unique in a grid
    targets: Path | None  # cameras of held-out views
    target_images: Path | None  # folder of their photos; None: found by their cameras
    num_views: int | None  # number of views in its camera file, an upper bound for the scene; None if unknown
    sha256: str  # hash of all files that are read


def find_sources(
    arguments: Sequence[str], out: Path, targets: str | None = None, target_images: str | None = None
) -> list[ChartScene]:
    """Find scenes as ``gsmerge batch`` does, and hash all files of each.

    ``targets`` are the cameras of held-out views, and ``target_images`` is the folder of their photos. Each is one path
    for all scenes, or a template with ``{scene}`` (as given), ``{parent}`` (its folder) and ``{stem}`` (its name
    without extension). Raises SceneError if a file is missing, and UsageError if a template has another name.
    """
    scenes = list({main_file(scene).resolve(): scene for scene in find_scenes(arguments, out)}.values())
    sources = []
    for scene, name in zip(scenes, scene_names(scenes), strict=True):
        files, cameras = find_scene_files(scene), fill_template(targets, scene)
        photos = fill_template(target_images, scene)
        read = list_files(files)
        if cameras is not None:
            if not cameras.exists():
                raise SceneError(cameras, f"expected cameras of held-out views of {scene}, found nothing")
            # other files in a folder of cameras, such as results, are ignored
            inside = find_cameras(cameras) if cameras.is_dir() and not is_colmap(cameras) else None
            read += [inside or cameras, *list_photos(cameras)]
        read += [] if photos is None else [photos]
        scene_cameras = None if files.cameras is None else try_cameras(files.cameras, files.ply.stem)
        num_views = None if scene_cameras is None else len(scene_cameras)
        sha256 = content_hash(list(dict.fromkeys(read)))
        sources.append(ChartScene(scene, name, cameras, photos, num_views, sha256))
    return sources


def scene_names(scenes: Sequence[Path]) -> list[str]:
    """Name each scene by its file or folder, with as many parent folders as are needed to make the names unique."""
    parts = [(*scene.absolute().parent.parts[1:], scene_name(scene.absolute())) for scene in scenes]
    for depth in range(1, max(map(len, parts), default=0)):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return ["/".join(part) for part in parts]


def make_jobs(
    sources: Sequence[ChartScene], grid: SettingsGrid, measured: EvaluateOptions, *, seed: int = 0, command: str = ""
) -> tuple[list[Job], list[str]]:
    """Make the jobs of a grid, scene by scene, and notes on combinations left out.

    ``command`` is the command line for the records. Raises UsageError if a setting is invalid.
    """
    combinations, notes = list_settings(grid)
    counts = [None if count == ALL else int(count) for count in grid.views]
    grid_points = [
        (method, settings, count, _options_of(method, settings, seed))
        for count, (method, settings) in product(counts, combinations)
    ]
    jobs: list[Job] = []
    for source in sources:
        num_views = source.num_views or math.inf
        limit = num_views - 1 if None in counts else num_views  # the run with all views is listed already
        runs = [point for point in grid_points if (point[2] or 0) <= limit]
        if len(runs) < len(grid_points):
            num_skipped = len(grid_points) - len(runs)
            problem = f"{source.name} has fewer views than asked for, or as many as all"
            notes.append(f"{problem}: {num_skipped} run(s) left out")
        num_gaussians, num_rest = estimate_counts(scene_plys(source.path))
        for method, settings, views, options in runs:
            label = describe(method, settings, views)
            output = f"{source.name}/{_file_name(label)}"
            record = RunRecord(source.name, label, output, source.sha256, method, settings, views, command)
            run = ChartRun(record, options, measured, source.targets, source.target_images)
            share = min(1.0, (views or num_views) / num_views) if source.num_views else 1.0
            jobs.append(Job(str(source.path), (output,), run, round(share * num_gaussians), num_rest))
    return jobs, notes


def _file_name(label: str) -> str:
    """Make a name that is valid in file systems and shells; a changed or shortened label gets a hash."""
    name = re.sub(r"[^\w.%+=, -]", "_", label)[:MAX_NAME]
    return name if name == label else f"{name} {digest({'label': label})[:6]}"
