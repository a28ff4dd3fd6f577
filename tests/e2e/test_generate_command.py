"""``gsmerge lab generate``, and its scenes in other commands."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from messages import names

from gsmerge.cli import main

from .conftest import Run, assert_refused, listing

SMALL = ("--scenes", 2, "--views", "3", "--size", "48x36")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes. Read only."""
    folder = tmp_path_factory.mktemp("generate") / "made"
    assert main(["lab", "generate", "-o", str(folder), *map(str, SMALL), "--quiet"]) == 0
    return folder


@pytest.fixture
def made(generated: Path, tmp_path: Path) -> Path:
    """A copy of these that a test may change."""
    return Path(shutil.copytree(generated, tmp_path / "made"))


def test_scenes_are_made_and_counted(generated: Path, tmp_path: Path, run: Run) -> None:
    outcome = run("lab", "generate", "-o", tmp_path / "made", *SMALL, code=0)
    assert outcome.err == ""
    assert outcome.out == f"{tmp_path / 'made'}: 2 scenes\n"
    assert listing(tmp_path / "made") == listing(generated)


def test_other_commands_read_the_scenes(made: Path, run: Run) -> None:
    actual = json.loads(run("inspect", made / "scene_0001", "--json").out)
    assert (actual["exporter"], actual["num_views"], actual["num_missing"], actual["notes"]) == ("gsmerge", 3, 0, [])
    run("compact", made / "scene_0001", "--set", "superpixels=5%", "--fit", "none", code=0)
    targets = made / "scene_0001" / "targets"
    run("evaluate", made / "scene_0001", "--targets", targets, "--lpips", "none", "--json", code=0)


def test_a_second_call_keeps_and_adds(made: Path, run: Run) -> None:
    before = listing(made)
    assert names(run("lab", "generate", "-o", made, *SMALL).out, "0 scenes", 2)
    assert listing(made) == before
    more = json.loads(run("lab", "generate", "-o", made, *SMALL, "--scenes", 3, "--json").out)
    assert [scene["kept"] for scene in more["scenes"]] == [True, True, False]
    assert more["options"]["views"] == [3, 3]


def test_scenes_of_other_settings_are_not_replaced(made: Path, run: Run) -> None:
    before = listing(made)
    assert_refused(run("lab", "generate", "-o", made, *SMALL, "--set", "seed=1"), 2, made / "scene_0000", "overwrite")
    assert listing(made) == before


def test_noise_is_taken(tmp_path: Path, run: Run) -> None:
    run("lab", "generate", "-o", tmp_path / "made", *SMALL, "--scenes", 1, "--set", "noise=0", code=0)
    record = json.loads((tmp_path / "made" / "scene_0000" / "generated.json").read_text())
    assert record["noise"]["grain"] == 0
