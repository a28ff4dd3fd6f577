"""Settings have names, types and ranges, and ask of a run one piece, all views, or a number of Gaussians."""

from __future__ import annotations

import json
import subprocess
import sys
import uuid
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import get_type_hints

import pytest
from messages import refuses

from gsmerge import CompactOptions
from gsmerge.settings.compact import ONE_PIECE, TRIAL
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.keywords import BatchSettings, CompactSettings
from gsmerge.settings.setting import flat_settings

STAGES = [f.name for f in fields(CompactOptions) if is_dataclass(getattr(CompactOptions(), f.name))]


def test_flat_names_are_unique() -> None:
    options = CompactOptions()
    names = [name for stage in STAGES for name in flat_settings(type(getattr(options, stage)))]
    names += [f.name for f in fields(options) if f.name not in STAGES]
    assert len(names) == len(set(names))
    assert sorted(options.to_dict()) == sorted(names)


def test_settings_reach_their_stage() -> None:
    options = CompactOptions().with_settings({"k": 2, "superpixels": "1%", "match": "aabb", "fit": "none", "seed": 3})
    assert options.decode.k == 2
    assert options.segment.share == 0.01
    assert options.match.match == "aabb"
    assert options.fit.fit == "none"
    assert (options.seed, options.threads) == (3, None)
    assert options.clean == CompactOptions().clean


def test_flat_settings_make_the_same_options() -> None:
    changed = CompactOptions().with_settings({"k": 4, "overlap": 0.5})
    assert CompactOptions().with_settings(changed.to_dict()) == changed
    assert CompactOptions().with_settings({}) == CompactOptions()


def test_settings_are_plain_values() -> None:
    assert json.loads(json.dumps(CompactOptions().to_dict())) == CompactOptions().to_dict()


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with refuses(ValueError, "", "'xyz'", "k", "quality"):
        CompactOptions().with_settings({"k": 2, "xyz": 3})
    with refuses(ValueError, "", "'budgte'", "perhaps budget"):
        CompactOptions().with_settings({"budgte": 3})


@pytest.mark.parametrize("stage", STAGES)
def test_every_setting_is_documented(stage: str) -> None:
    options = getattr(CompactOptions(), stage)
    assert all(f"{f.name}: " in type(options).__doc__ for f in fields(options))


@pytest.mark.parametrize(
    "setting",
    [
        {"k": 0}, {"k": 9}, {"k": -1}, {"superpixels": 0}, {"superpixels": "0%"}, {"superpixels": "150%"},
        {"segmentation": "voronoi"}, {"effort": "slow"}, {"recipe": "soup"}, {"match": "iou"}, {"fit": "everything"},
        {"cluster_size": 0}, {"neighbors": 0}, {"fit_steps": 0}, {"holdout": 2.0},
        {"dropout": 1.0}, {"dropout": -0.1}, {"holdout": 0.0},
        {"min_opacity": -1.0}, {"overlap": float("nan")}, {"compactness": 2.0}, {"iou": 1.1}, {"similarity": -1.1},
        {"blocks": 0}, {"blocks": "some"}, {"blocks": True},
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused_before_any_work(setting: dict) -> None:
    (name,) = setting
    with pytest.raises(ValueError, match=name):
        CompactOptions().with_settings(setting)


WHOLE = asdict(CompactOptions())


@pytest.mark.parametrize(("call", "place", "values"), [
    (lambda: CompactOptions(budget="4%"), "budget", ["BudgetOptions", "'4%'"]),
    (lambda: CompactOptions("4%"), "prepare", ["PrepareOptions", "CompactOptions"]),
    (lambda: replace(CompactOptions(), fit=None), "fit", ["FitOptions", "CompactOptions"]),
    (lambda: CompactOptions(**WHOLE), "prepare", ["PrepareOptions", "CompactOptions"]),
    (lambda: CompactOptions().with_settings({"quality": 30}), "quality", ['"-0.2dB"', '"30dB"']),
])  # fmt: skip
def test_values_that_are_no_settings_of_a_stage_are_named(
    call: Callable[[], CompactOptions], place: str, values: list[object]
) -> None:
    with refuses(ValueError, place, *values):
        call()


def test_settings_are_a_dictionary() -> None:
    assert CompactOptions().with_settings(CompactOptions().to_dict()) == CompactOptions()
    with refuses(TypeError, "settings", "str"):
        CompactOptions().with_settings("4%")  # type: ignore[arg-type]
    with refuses(ValueError, "", "3", "k", "quality"):
        CompactOptions().with_settings({3: 4, "a": 5})  # type: ignore[dict-item]


@pytest.mark.parametrize("values", [ONE_PIECE, TRIAL])
def test_values_for_parts_of_a_scene_are_possible(values: dict[str, object]) -> None:
    assert CompactOptions().with_settings(values).to_dict().items() >= values.items()


def test_settings_that_need_the_scene_in_one_piece_are_named() -> None:
    asked = {"method": "greedy", "budget": 100, "crop": "sphere:0,0,0,1", "drop": "floaters, unseen"}
    named = CompactOptions().with_settings(asked).whole_only
    assert set(named) == {"method greedy", "crop", "drop floaters", "drop unseen"}
    levels = CompactOptions().with_settings({"levels": 2, "quality": "30dB"})
    assert set(levels.whole_only) == {"levels", "quality 30dB"}
    assert CompactOptions().whole_only == CompactOptions().uncut == []
    uncut = CompactOptions().with_settings({"budget": "auto", "poses": "free", "exposure": "per-photo"})
    assert set(uncut.uncut) == {"budget auto", "poses free", "exposure per-photo"}
    assert uncut.whole_only == []


def test_settings_tell_whether_the_scene_decides_the_count() -> None:
    def decides(**settings: object) -> tuple[bool, bool, bool]:
        options = CompactOptions().with_settings(settings)
        return options.scene_decides, options.replaces_stages, options.changes_superpixels

    assert decides() == decides(budget="auto") == decides(budget="mobile") == decides(checkpoint="none")
    assert decides() == (True, False, False)
    assert decides(budget=100) == decides(k=2) == decides(superpixels="2%") == decides(quality="30dB")
    assert decides(budget=100) == (False, False, False)
    assert decides(checkpoint="shipped") == (False, True, False)
    assert decides(match="none") == decides(compactness=0.1) == decides(k_low=20.0) == (True, False, True)


CALLS = """# mypy: disallow-untyped-calls, disallow-any-generics, warn-return-any, strict-equality, extra-checks
import gsmerge
gsmerge.compact("room", budget="2%", k=2, fit="none")
gsmerge.compact("room", budgte="2%")
gsmerge.compact("room", fit="nothing")
gsmerge.Compactor(max_views=3, effort="draft").compact(levels=2)
gsmerge.Compactor(maxviews=3)
"""


def test_settings_have_the_types_of_their_fields() -> None:
    declared = {name: setting.kind for name, setting in flat_settings(CompactOptions).items()}
    assert get_type_hints(CompactSettings) == declared
    added = {name: setting.kind for name, setting in flat_settings(ExtendOptions).items()}
    assert get_type_hints(BatchSettings) == declared | added


@pytest.mark.slow  # mypy reads the package, which takes half a minute, unless ``tasks.py types`` has
def test_a_type_checker_refuses_settings_that_do_not_exist(tmp_path: Path, root: Path) -> None:
    """By the settings of the package, whose cache is used, and as strictly as ``--strict`` in the user's file."""
    calls = tmp_path / f"calls_{uuid.uuid4().hex}.py"  # a cache of mypy would name an earlier file of this name
    calls.write_text(CALLS)
    call = [sys.executable, "-m", "mypy", "--no-error-summary", str(calls)]
    lines = subprocess.run(call, capture_output=True, text=True, check=False, cwd=root).stdout.splitlines()
    wrong = {line.split(":")[1] for line in lines if line.startswith(str(tmp_path)) and ": error: " in line}
    assert wrong == {"4", "5", "7"}
