"""``gsmerge lab generate``, and its scenes in other commands."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from messages import names

from gsmerge.cli import main

from .conftest import Run, assert_refused, listing

SMALL = ("--scenes", 1, "--views", "3", "--size", "24x16")  # a scene takes half a second, however small it is


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, and what the command said of it. Read only."""
    folder = tmp_path_factory.mktemp("generate") / "made"
    with (folder.parent / "said.txt").open("w") as said, redirect_stdout(said):
        assert main(["lab", "generate", "-o", str(folder), *map(str, SMALL)]) == 0
    return folder


@pytest.fixture
def made(generated: Path, tmp_path: Path) -> Path:
    """A copy of these that a test may change."""
    return Path(shutil.copytree(generated, tmp_path / "made"))


def test_scenes_are_made_and_counted(generated: Path) -> None:
    assert (generated.parent / "said.txt").read_text() == f"{generated}: 1 scene\n"
    assert [path.name for path in generated.iterdir()] == ["scene_0000"]


def test_other_commands_read_the_scenes(made: Path, run: Run) -> None:
    actual = json.loads(run("inspect", made / "scene_0000", "--json").out)
    assert (actual["exporter"], actual["num_views"], actual["num_missing"], actual["notes"]) == ("gsmerge", 3, 0, [])
    run("compact", made / "scene_0000", "--set", "superpixels=5%", "--fit", "none", code=0)
    targets = made / "scene_0000" / "targets"
    run("evaluate", made / "scene_0000", "--targets", targets, "--lpips", "none", "--json", code=0)


@pytest.mark.slow
def test_a_second_call_keeps_and_adds(made: Path, run: Run) -> None:
    before = listing(made)
    assert names(run("lab", "generate", "-o", made, *SMALL).out, "0 scenes", 1)
    assert listing(made) == before
    more = json.loads(run("lab", "generate", "-o", made, *SMALL[2:], "--scenes", 2, "--json").out)
    assert [scene["kept"] for scene in more["scenes"]] == [True, False]
    assert more["options"]["views"] == 3


def test_scenes_of_other_settings_are_not_replaced(made: Path, run: Run) -> None:
    before = listing(made)
    assert_refused(run("lab", "generate", "-o", made, *SMALL, "--set", "seed=1"), 2, made / "scene_0000", "remove it")
    assert listing(made) == before
