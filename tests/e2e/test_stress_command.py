"""``gsmerge lab stress`` works as users call it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from messages import names

from .conftest import Run


@pytest.mark.slow
def test_json_and_quiet(small_scene: Path, run: Run) -> None:
    quick = ("--set", "fit=none", "--cases", "unchanged,order")
    document = json.loads(run("lab", "stress", small_scene, *quick, "--json").out)
    assert [case["case"] for case in document["cases"]] == ["unchanged", "order"]
    assert (document["held"], document["failed"]) == (2, 0)
    assert names(document["cases"][0]["wanted"], "0.1 dB")
    outcome = run("lab", "stress", small_scene, *quick, "--quiet")
    assert (outcome.out, outcome.err) == ("", "")


def test_failed_case_ends_as_a_target_not_met(small_copy: Path, run: Run) -> None:
    poor = ("--set", "fit=none", "--set", "superpixels=1%")
    outcome = run("lab", "stress", small_copy, *poor, "--cases", "order,views-1,unchanged")
    failed = [line for line in outcome.out.splitlines() if line.startswith("FAILED")]
    assert failed, "so few Gaussians without a fit must be worse than the input somewhere"
    assert outcome.code == 4
    assert f"{len(failed)} of 3 cases" in outcome.err
