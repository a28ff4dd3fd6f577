"""``gsmerge lab generate`` makes scenes that other commands read."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import pytest

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
