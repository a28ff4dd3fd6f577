"""``gsmerge generate``, and its scenes in other commands."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from gsmerge.cli import main

from .conftest import Run, listing

COMPILING = "compiling kernels for their first use, up to 30 s\n"
SMALL = ("--scenes", 2, "--views", "3", "--size", "48x36")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes. Read only."""
    folder = tmp_path_factory.mktemp("generate") / "made"
    assert main(["generate", "-o", str(folder), *map(str, SMALL), "--quiet"]) == 0
    return folder


@pytest.fixture
def made(generated: Path, tmp_path: Path) -> Path:
    """A copy of these that a test may change."""
    return Path(shutil.copytree(generated, tmp_path / "made"))


def test_scenes_are_made_and_counted(generated: Path, tmp_path: Path, run: Run) -> None:
    outcome = run("generate", "-o", tmp_path / "made", *SMALL)
    assert outcome.code == 0
    assert outcome.err in ("", COMPILING)
    assert outcome.out == f"{tmp_path / 'made'}: 2 scenes\n"
    assert listing(tmp_path / "made") == listing(generated)


def test_other_commands_read_the_scenes(made: Path, run: Run) -> None:
    actual = json.loads(run("inspect", made / "scene_0001", "--json").out)
    assert (actual["exporter"], actual["num_views"], actual["num_missing"], actual["notes"]) == ("gsmerge", 3, 0, [])
    compacted = run("compact", made / "scene_0001", "--superpixels", "5%", "--fit", "none")
    assert compacted.code == 0, compacted.err
    targets = made / "scene_0001" / "targets"
    scored = run("evaluate", made / "scene_0001", "--targets", targets, "--lpips", "none", "--json")
    assert scored.code == 0, scored.err


def test_a_second_call_keeps_and_adds(made: Path, run: Run) -> None:
    before = listing(made)
    assert run("generate", "-o", made, *SMALL).out.endswith("0 scenes, 2 were there already\n")
    assert listing(made) == before
    more = json.loads(run("generate", "-o", made, *SMALL, "--scenes", 3, "--json").out)
    assert [scene["kept"] for scene in more["scenes"]] == [True, True, False]
    assert more["options"]["views"] == [3, 3]


def test_a_dry_run_writes_nothing(tmp_path: Path, run: Run) -> None:
    outcome = run("generate", "-o", tmp_path / "made", *SMALL, "--dry-run")
    assert outcome.out.endswith("would write 2 scenes\n")
    assert json.loads(run("generate", "-o", tmp_path / "made", *SMALL, "--dry-run", "--json").out)["dry_run"] is True
    assert list(tmp_path.iterdir()) == []


def test_quiet_says_nothing(tmp_path: Path, run: Run) -> None:
    outcome = run("generate", "-o", tmp_path / "made", *SMALL, "--quiet")
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "")


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("--views", "many"), 2, "--views: expected a number such as 6"),
        (("--views", "1"), 2, "views: expected 2 to 200"),
        (("--size", "large"), 2, "--size: expected width and height such as 320x240"),
        (("--size", "9x9"), 2, "width: expected 16 to 2048"),
        (("--style", "castle"), 2, "style: expected mixed, room"),
        (("--path", "spiral"), 2, "path: expected mixed, arc"),
        (("--ranges", "nowhere.toml"), 3, "nowhere.toml: expected a TOML or JSON file"),
        (("--seed", "1"), 2, "pass --overwrite"),
    ],
)
def test_what_is_wrong_is_one_line(arguments: tuple[str, ...], code: int, said: str, made: Path, run: Run) -> None:
    before = listing(made)
    outcome = run("generate", "-o", made, *SMALL, *arguments)
    assert outcome.code == code
    assert said in outcome.err
    assert outcome.err.count("\n") == 1
    assert listing(made) == before


def test_a_file_is_no_folder(tmp_path: Path, run: Run) -> None:
    (tmp_path / "made").write_text("notes")
    outcome = run("generate", "-o", tmp_path / "made", *SMALL)
    assert outcome.code == 3
    assert "found a file" in outcome.err


def test_ranges_and_noise_are_taken(tmp_path: Path, run: Run) -> None:
    ranges = tmp_path / "ranges.json"
    ranges.write_text('{"scale": [0.7, 0.7], "sh_degrees": [1]}')
    outcome = run("generate", "-o", tmp_path / "made", *SMALL, "--scenes", 1, "--ranges", ranges, "--noise", 0)
    assert outcome.code == 0, outcome.err
    record = json.loads((tmp_path / "made" / "scene_0000" / "generated.json").read_text())
    drawn = record["noise"]
    assert (drawn["scale"], drawn["sh_degree"], drawn["grain"]) == (0.7, 1, 0)
