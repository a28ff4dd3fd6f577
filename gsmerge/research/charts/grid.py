"""Make the runs of a grid of settings. Every combination of the listed values is run on every scene."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError, UsageError
from gsmerge.jobs.batch.find import find_scenes, main_file
from gsmerge.jobs.content_hash import content_hash, digest, fill_template, list_files, list_photos, scene_name
from gsmerge.plan.methods import find_method
from gsmerge.reading.scene_files import SceneFiles, find_scene_files
from gsmerge.research.charts.lines import SIZE_SETTINGS
from gsmerge.research.charts.measure_run import ChartScene, RunRecord, describe_run
from gsmerge.scoring.evaluate import INPUT, EvaluateOptions
from gsmerge.settings.compact import OURS, CompactOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.version import __version__

COMMON_SETTINGS = ("seed", "threads")  # used by all methods
SettingGrid = Mapping[str, Sequence[Any]]  # the values of each setting, by the setting's name
GridRun = tuple[ChartScene, RunRecord, CompactOptions]  # scene, record without results, options


def parse_grid(pairs: Sequence[str]) -> SettingGrid:
    """Make a grid from pairs NAME=A,B with names of settings of compact.

    Raises UsageError if the name of a setting is unknown or given twice, or if a pair has no values.
    """
    grid: dict[str, list[Any]] = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        values = [parse_grid_value(part.strip()) for part in text.split(",") if part.strip()]
        if name not in flat_settings(CompactOptions) or name in grid or not values:
            raise UsageError(f"--grid {pair}: expected a setting of compact, each once, with values: NAME=A,B")
        grid[name] = values
    return grid


def parse_grid_value(text: str) -> Any:
    """Parse a number, true or false; return any other text unchanged."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def list_settings(grid: SettingGrid, fixed: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """List (method, settings) of every run on one scene, the unmerged input first.

    Each run has one budget or one number of superpixels. Every budget and every number of superpixels is combined with
    all values of the other settings. ``fixed`` settings hold for all runs. A baseline gets only the settings that it
    uses. Raises UsageError if a method is unknown, if a setting is invalid, or if a method needs a program that is not
    installed.
    """
    sizes = [{name: value} for name in SIZE_SETTINGS for value in grid.get(name, ())] or [{}]
    others = {name: values for name, values in grid.items() if name not in (*SIZE_SETTINGS, "method")}
    runs: dict[str, tuple[str, dict[str, Any]]] = {INPUT: (INPUT, {})}
    for method in grid.get("method", (OURS,)):
        used = None if method == OURS else (*find_method(options_of(method, {}).method).uses, *COMMON_SETTINGS)
        for size, *values in product(sizes, *others.values()):
            chosen = {**size, **dict(zip(others, values, strict=True))}
            chosen |= {name: value for name, value in fixed.items() if name not in chosen}
            settings = {name: value for name, value in chosen.items() if used is None or name in used}
            runs.setdefault(describe_run(method, settings), (method, settings))
    return list(runs.values())


def options_of(method: str, settings: Mapping[str, Any]) -> CompactOptions:
    """Make the options of a run, or raise UsageError if a setting is invalid.

    By default a run uses all of its budget ("fill"), so that results of one size can be compared.
    """
    try:
        baseline = {} if method in (OURS, INPUT) else {"method": method}
        return CompactOptions().with_settings({"fill": True, **settings, **baseline})
    except ValueError as error:
        raise UsageError(str(error)) from error


def find_sources(arguments: Sequence[str], out: Path, targets: str | None = None) -> list[ChartScene]:
    """Find scenes as ``gsmerge batch`` does, and hash the files of each scene, so that finished runs can be recognised.

    ``targets`` are the cameras of held-out views: one path for all scenes, or a template with ``{scene}`` (the path as
    given), ``{parent}`` (the scene's folder) and ``{stem}`` (the scene's name without extension). Raises SceneError if
    a file is missing, and UsageError if a template has another name.
    """
    scenes = list({main_file(scene).resolve(): scene for scene in find_scenes(arguments, out)}.values())
    sources = []
    for scene, name in zip(scenes, scene_names(scenes), strict=True):
        cameras = fill_template(targets, scene)
        read = list_files(find_scene_files(scene))
        if cameras is not None:
            if not cameras.exists():
                raise SceneError(cameras, f"expected cameras of held-out views of {scene}, found nothing")
            read += [cameras, *list_photos(SceneFiles(scene, cameras, None), cameras)]
        sources.append(ChartScene(scene, name, cameras, content_hash(list(dict.fromkeys(read)))))
    return sources


def scene_names(scenes: Sequence[Path]) -> list[str]:
    """Name each scene by its file or folder, with as many parent folders as are needed to make the names unique."""
    parts = [(*scene.absolute().parent.parts[1:], scene_name(scene.absolute())) for scene in scenes]
    for depth in range(1, max(map(len, parts), default=0)):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return ["/".join(part) for part in parts]


def make_runs(
    sources: Sequence[ChartScene], grid: SettingGrid, fixed: Mapping[str, Any], measured: EvaluateOptions
) -> list[GridRun]:
    """Make the runs of a grid, scene by scene. Raises UsageError if a setting is invalid."""
    combinations = [(method, settings, options_of(method, settings)) for method, settings in list_settings(grid, fixed)]
    runs = []
    for source, (method, settings, options) in product(sources, combinations):
        facts = {"scene": source.sha256, "method": method, "settings": settings, "measured": asdict(measured)}
        key = digest({**facts, "tool_version": __version__})
        runs.append((source, RunRecord(source.name, describe_run(method, settings), key, method, settings), options))
    return runs
