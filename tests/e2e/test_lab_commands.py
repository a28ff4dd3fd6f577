"""``gsmerge lab generate`` makes scenes that other commands read, and ``lab stress`` works as users call it."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from messages import names

from gsmerge.cli import main

from .conftest import Run

SMALL = ("--scenes", 1, "--views", "3", "--size", "24x16")  # a scene takes half a second, however small it is


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene, and what the command said of it. Read only."""
    folder = tmp_path_factory.mktemp("generate") / "made"
    with (folder.parent / "said.txt").open("w") as said, redirect_stdout(said):
        assert main(["lab", "generate", "-o", str(folder), *map(str, SMALL)]) == 0
    return folder


def test_generate_prints_the_number_of_scenes_that_it_writes(generated: Path) -> None:
    assert (generated.parent / "said.txt").read_text() == f"{generated}: 1 scene\n"
    assert [path.name for path in generated.iterdir()] == ["scene_0000"]


def test_other_commands_read_generated_scenes(generated: Path, tmp_path: Path, run: Run) -> None:
    made = Path(shutil.copytree(generated, tmp_path / "made"))
    actual = json.loads(run("inspect", made / "scene_0000", "--json").out)
    assert (actual["exporter"], actual["num_views"], actual["num_missing"], actual["notes"]) == ("gsmerge", 3, 0, [])
    run("compact", made / "scene_0000", "--set", "superpixels=5%", "--fit", "none", code=0)
    targets = made / "scene_0000" / "targets"
    run("evaluate", made / "scene_0000", "--targets", targets, "--lpips", "none", "--json", code=0)


@pytest.mark.slow
def test_stress_prints_json_alone_or_nothing_if_quiet(small_scene: Path, run: Run) -> None:
    quick = ("--set", "fit=none", "--cases", "unchanged,order")
    document = json.loads(run("lab", "stress", small_scene, *quick, "--json").out)
    assert [case["case"] for case in document["cases"]] == ["unchanged", "order"]
    assert (document["held"], document["failed"]) == (2, 0)
    assert names(document["cases"][0]["wanted"], "0.1 dB")
    outcome = run("lab", "stress", small_scene, *quick, "--quiet")
    assert (outcome.out, outcome.err) == ("", "")


@pytest.mark.slow
def test_failed_case_ends_as_a_target_not_met(small_copy: Path, run: Run) -> None:
    poor = ("--set", "fit=none", "--set", "superpixels=1%")
    outcome = run("lab", "stress", small_copy, *poor, "--cases", "order,views-1,unchanged")
    failed = [line for line in outcome.out.splitlines() if line.startswith("FAILED")]
    assert failed, "so few Gaussians without a fit must be worse than the input somewhere"
    assert outcome.code == 4
    assert f"{len(failed)} of 3 cases" in outcome.err
