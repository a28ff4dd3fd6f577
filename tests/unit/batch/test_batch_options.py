"""Settings of a batch that go together, and those that do not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from messages import refuses

from gsmerge.batch import BatchOptions
from gsmerge.settings.compact import CompactOptions


def test_runs_that_may_share_a_folder_have_one_name() -> None:
    settings = CompactOptions()
    base = BatchOptions(settings)
    same = (replace(base, jobs=3), replace(base, settings=settings.with_settings({"threads": 2}), rerun=True))
    others = (
        replace(base, settings=settings.with_settings({"k": 2})),
        replace(base, output="{index}.ply"),
        replace(base, opacity="raw"),
        replace(base, cameras="{parent}/cameras.json"),
    )
    assert {one.name() for one in same} == {base.name()}
    assert len({base.name(), *(one.name() for one in others)}) == 5


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"jobs": 0}, ("jobs", 1, 0)), ({"retries": -1}, ("retries", 0, -1)), ({"timeout": 0.0}, ("timeout", "0.0")),
        ({"timeout": math.nan}, ("timeout", "nan")), ({"max_memory": 0}, ("max_memory", 1, 0)),
        ({"engine": "slurm"}, ("engine", "'slurm'")), ({"address": "auto"}, ("address", "ray", "local")),
        ({"engine": "ray", "max_memory": 5}, ("max_memory", "local", "Ray")),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(wrong: dict[str, Any], named: tuple[object, ...]) -> None:
    with refuses(ValueError, *named):
        BatchOptions(**wrong)


@pytest.mark.parametrize(
    "template",
    ["{name}.ply", "{stem.real}.ply", "{0}.ply", "{}.ply", "{stem", "{stem}.txt", "/x/{stem}.ply", "../{stem}.ply"],
)
def test_templates_that_make_no_sense_are_refused(template: str) -> None:
    with refuses(ValueError, "output"):
        BatchOptions(output=template)
