"""The grid of experiments: the product of lists, without combinations that make no sense."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

from gsmerge.budget import share_text
from gsmerge.errors import SceneError, UsageError
from gsmerge.io.bounds import read_table
from gsmerge.research.charts.record import INPUT

OURS = "gsmerge"
ALL = "all"  # word for all views
SIZES = ("budget", "superpixels")
ONE_SIZE = ("unmerged", "unmerged-fit")  # methods that keep all Gaussians
OWN_OPTIONS = {"method": "--methods", "seed": "--seed", "threads": "--threads"}  # that set the same
FITTED = {"unmerged-fit": ("effort",)}  # settings of ours that baselines have, too
NUMBERS = ("k", "budgets", "superpixels", "views")  # lists whose values may be numbers
# Settings whose lists are multiplied, and the lists' names:
SETTINGS = {"k": "k", "segmentation": "segmentations", "fit": "fit", "effort": "efforts", "match": "matches"}


@dataclass(frozen=True)
class Experiment:
    """One run."""

    scene: Path  # A .ply or the folder that it is in
    method: str = OURS  # gsmerge, the name of a baseline, or input: nothing is merged, only measured
    settings: Mapping[str, Any] = field(default_factory=dict)  # settings that differ from the defaults, by flat name
    views: int | None = None  # number of views, evenly spread; None: all


@dataclass(frozen=True)
class Grid:
    """Lists whose product is run; a ValueError if one is empty that must not be, or a value is impossible."""

    methods: tuple[str, ...] = (OURS,)  # ``gsmerge`` and baselines
    k: tuple[int, ...] = (1,)  # Gaussians per superpixel: 1 to 8
    budgets: tuple[int | str, ...] = ()  # Gaussians in the result, such as 40000, "2%" or "auto"
    # superpixels per view, such as 3000 or "4.4%"; in addition to the budgets, not times them
    superpixels: tuple[int | str, ...] = ()
    segmentations: tuple[str, ...] = ("rdseg",)  # superpixel methods
    fit: tuple[str, ...] = ("full",)  # ``full``, ``color``, ``none``
    efforts: tuple[str, ...] = ("default",)  # ``draft``, ``fast``, ``default``, ``best``
    matches: tuple[str, ...] = ("overlap",)  # merging across views: ``overlap``, ``aabb``, ``none``
    views: tuple[int | str, ...] = (ALL,)  # numbers of views; "all" for all
    fixed: tuple[str, ...] = ()  # any other settings of ours, each "name=value", the same in all runs

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not value and f.name not in ("budgets", "superpixels", "fixed"):
                raise ValueError(f"{f.name}: expected at least one value, got none")
            if len(set(value)) < len(value):
                raise ValueError(f"{f.name}: expected every value once, got {', '.join(map(str, value))}")
        for value in self.views:
            if value != ALL and not (isinstance(value, int) and value >= 1):
                raise ValueError(f'views: expected numbers from 1 or "all", got {value!r}')

    @property
    def settings(self) -> dict[str, Any]:
        """The fixed settings by name; a UsageError if one is not "name=value", or a setting that cannot be fixed."""
        settings: dict[str, Any] = {}
        for text in self.fixed:
            name, sign, value = str(text).partition("=")
            if not (name and sign):
                raise UsageError(f"fixed: expected NAME=VALUE, got {text!r}")
            if name in OWN_OPTIONS:
                raise UsageError(f"fixed: expected another setting, got {name}; use {OWN_OPTIONS[name]}")
            settings[name] = value
            with suppress(ValueError):  # a word
                settings[name] = json.loads(value)
            plain = settings[name] is None or isinstance(settings[name], str | int | float)
            if not plain or settings[name] != settings[name]:
                raise UsageError(f"fixed: expected a word or a number for {name}, got {value}")
        return settings


def parse_grid(lists: Mapping[str, str | None], base: Grid | None = None) -> Grid:
    """A grid from comma-separated lists, None leaves the base's; a UsageError if a value is impossible."""
    values: dict[str, tuple[Any, ...]] = {}
    for name, text in lists.items():
        if text is not None:
            parts = [part.strip() for part in text.split(",") if part.strip()]
            values[name] = tuple(int(part) if name in NUMBERS and part.isdecimal() else part for part in parts)
    try:
        return replace(base or Grid(), **values)
    except ValueError as error:
        raise UsageError(str(error)) from error


def read_grid(path: Path) -> Grid:
    """A grid from a small TOML or JSON file whose keys are the fields of :class:`Grid`.

    A SceneError if the file cannot be read, or holds anything else.
    """
    values, known = read_table(path), {f.name for f in fields(Grid)}
    densities = values.pop("densities", None)  # the name and form of version 0.1.0
    if values.keys() - known:
        odd = ", ".join(sorted(values.keys() - known))
        raise SceneError(path, f"expected lists named {', '.join(sorted(known))}, found {odd}")
    try:
        if densities is not None:
            shares = densities if isinstance(densities, list) else [densities]
            values["superpixels"] = [share_text(share) for share in shares]
        return Grid(**{name: tuple(value) if isinstance(value, list) else (value,) for name, value in values.items()})
    except (TypeError, ValueError) as error:
        raise SceneError(path, str(error)) from error


def grid_settings(grid: Grid) -> tuple[list[tuple[str, dict[str, Any]]], list[str]]:
    """Method and settings of every run on one scene, the unmerged input first, and notes on what was left out.

    Only settings that differ from the defaults are set. Left out are efforts that do not change a superpixel method,
    and for baselines all settings that only ours has: they run once per size.
    """
    sizes: list[dict[str, Any]] = [{"budget": b} for b in grid.budgets] + [{"superpixels": s} for s in grid.superpixels]
    sizes = sizes or [{}]
    out: list[tuple[str, dict[str, Any]]] = [(INPUT, {})]
    dropped: Counter[str] = Counter()
    for method, *values, size in product(grid.methods, *(getattr(grid, name) for name in SETTINGS.values()), sizes):
        chosen = dict(zip(SETTINGS, values, strict=True))
        why = _skip_reason(method, chosen, grid)
        if method in ONE_SIZE and size != sizes[0]:
            why = why or f"{method} keeps all Gaussians"
        if why is not None:
            dropped[why] += 1
            continue
        own = SETTINGS if method == OURS else FITTED.get(method, ())
        changed = {name: chosen[name] for name in own if chosen[name] != getattr(Grid, SETTINGS[name])[0]}
        changed |= grid.settings if method == OURS else {}
        out.append((method, changed if method in ONE_SIZE else size | changed))
    return out, [f"{why}: {count} combination(s) left out" for why, count in dropped.items()]


def _skip_reason(method: str, chosen: Mapping[str, Any], grid: Grid) -> str | None:
    """Why a combination of settings is left out for a method; None if it is not."""
    first = {name: getattr(grid, field)[0] for name, field in SETTINGS.items()}
    if method != OURS:
        own = FITTED.get(method, ())
        if any(chosen[name] != first[name] for name in SETTINGS if name not in own):
            return f"{method} takes {' and '.join(own) or 'a size'} alone"
        return None
    other = chosen["effort"] != first["effort"] and "draft" not in (chosen["effort"], first["effort"])
    if chosen["segmentation"] != "rdseg" and chosen["fit"] != "full" and other:
        return "effort changes nothing for other superpixels than rdseg without a full fit"
    return None


def make_experiments(scenes: Sequence[Path], grid: Grid) -> tuple[list[Experiment], list[str]]:
    """All runs, scene by scene, and notes on what was left out; a UsageError if the library does not take a setting."""
    combinations, notes = grid_settings(grid)
    for method, settings in combinations:
        _check(method, settings)
    views = [None if count == ALL else int(count) for count in grid.views]
    runs = product(scenes, views, combinations)
    return [Experiment(scene, method, settings, count) for scene, count, (method, settings) in runs], notes


def _check(method: str, settings: Mapping[str, Any]) -> None:
    from gsmerge.baselines import check_program, find_baseline
    from gsmerge.options import CompactOptions

    try:
        CompactOptions().with_settings(run_settings(method, settings))
        baseline = None if method == INPUT else find_baseline(method)
    except ValueError as error:
        raise UsageError(str(error)) from error
    except TypeError as error:  # text instead of a number
        given = ", ".join(f"{name}={value}" for name, value in settings.items())
        raise UsageError(f"{method}: expected settings that compact takes, got {given}") from error
    if baseline is not None:
        check_program(baseline)


def run_settings(method: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings for ``compact``, with the method where it is a baseline."""
    return dict(settings) if method in (OURS, INPUT) else {**settings, "method": method}
