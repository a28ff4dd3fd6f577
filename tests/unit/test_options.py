from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass, replace

import pytest
from messages import refuses

from gsmerge import CompactOptions
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
