"""``extend``, and ``compact`` of states, on scenes that the project makes itself; and whatever may happen meanwhile."""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile.gsm_files import cut
from scripts import load_script

import gsmerge
from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.scene.files import find_scene_files
from gsmerge.scene.held_out import read_held_out
from gsmerge.scene.read import load_scene
from gsmerge.states.state_file import load_state

from .conftest import Run, assert_refused, listing

SMALL = ("--set", "superpixels=60", "--set", "checkpoint=none")
PATIENCE = 120  # seconds, on a machine that is busy with other things


@pytest.fixture(scope="session")
def walks(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Two scenes of the same room, three and four views of 24 x 16. Read only, which is checked."""
    folder = tmp_path_factory.mktemp("walks")
    scenes = [make_scene(folder / f"walk{n}", num_views=3 + n, width=24, height=16, seed=0) for n in range(2)]
    before = digests(folder)
    yield scenes
    assert digests(folder) == before


@pytest.fixture(scope="session")
def states(walks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The states after one and after two batches. Read only."""
    folder = tmp_path_factory.mktemp("states")
    assert main(["extend", str(folder / "1.gsm"), str(walks[0]), *map(str, SMALL), "--quiet"]) == 0
    shutil.copy(folder / "1.gsm", folder / "2.gsm")
    assert main(["extend", str(folder / "2.gsm"), str(walks[1]), "--quiet"]) == 0
    return [folder / "1.gsm", folder / "2.gsm"]


@pytest.fixture
def state(states: list[Path], tmp_path: Path) -> Path:
    """A state of one batch that a test may spoil."""
    (tmp_path / "work").mkdir()
    return Path(shutil.copy(states[0], tmp_path / "work" / "state.gsm"))


def digests(folder: Path) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()}


# batches


def test_several_batches_in_order(states: list[Path], walks: list[Path], tmp_path: Path, run: Run) -> None:
    """The states are those of three batches, made here for the module."""
    outcome = run("extend", tmp_path / "state.gsm", *walks, *SMALL)
    assert (outcome.code, outcome.out.count("\n")) == (0, 2), outcome.err
    first, second = outcome.out.splitlines()
    assert "state.gsm: batch 1, 3 views, 1,152 Gaussians ->" in first
    assert "state.gsm: batch 2, 4 views" in second
    assert list(listing(tmp_path)) == ["state.gsm"]
    assert (tmp_path / "state.gsm").read_bytes() == states[1].read_bytes()


def test_json_is_all_there_is_on_stdout(walks: list[Path], tmp_path: Path, run: Run) -> None:
    state = tmp_path / "state.gsm"
    outcome = run("extend", state, *walks, *SMALL, "--json")
    assert (outcome.code, outcome.err) == (0, "")
    batches = json.loads(outcome.out)["batches"]
    assert [one["state"]["num_batches"] for one in batches] == [1, 2]
    assert batches[1]["state"]["bytes"] == state.stat().st_size
    for one, walk, num_views in zip(batches, walks, (3, 4), strict=True):
        assert one["schema_version"] == 1
        assert one["tool"]["version"] == gsmerge.__version__
        assert Path(one["input"]["path"]) == walk / "scene.ply"
        assert one["num_input"] == num_views * 24 * 16
        assert one["num_groups"] > 0
        assert one["options"]["superpixels"] == 60
        assert {"load", "read", "write"} <= set(one["seconds"])
        assert min(one["seconds"].values()) >= -1e-3
        assert one["notes"] == []
    assert "import" in batches[0]["seconds"]
    assert "import" not in batches[1]["seconds"]
    numbers = ("num_views", "num_input", "num_new", "num_covered", "num_joined", "num_hidden", "num_groups")
    assert load_state(state).about["batches"] == [{name: one[name] for name in numbers} for one in batches]


def test_settings_are_those_of_the_state(walks: list[Path], tmp_path: Path, run: Run) -> None:
    state = tmp_path / "state.gsm"
    pairs = ("fit_colors=false", "tolerance=0", "max_k=2", "replay=2", "seed=5")
    said = (*SMALL, *(word for pair in pairs for word in ("--set", pair)))
    assert run("extend", state, walks[0], *said).code == 0
    first = load_state(state).about["options"]
    document = json.loads(run("extend", state, walks[1], "--json").out)["batches"][0]
    assert document["num_covered"] == 0
    same = {"superpixels": 60, "fit_colors": False, "tolerance": 0.0, "max_k": 2, "replay": 2, "seed": 5}
    assert same.items() <= first.items()
    assert same.items() <= document["options"].items()
    assert len(load_state(state).replay) <= 2


def test_cameras_of_one_batch(state: Path, walks: list[Path], tmp_path: Path, run: Run) -> None:
    scene = Path(shutil.copytree(walks[1], tmp_path / "scene"))
    moved = shutil.move(scene / "transforms.json", tmp_path / "poses.json")
    said = ("--cameras", moved, "--images", scene / "images")
    assert run("extend", state, scene / "scene.ply", *said).code == 0


# decoding


def test_fits_to_the_photos_that_were_kept(states: list[Path], tmp_path: Path, run: Run) -> None:
    said = ("--set", "fit_steps=4")
    for fit in ((), ("--fit", "full")):
        out = tmp_path / f"{len(listing(tmp_path))}.ply"
        outcome = run("compact", states[1], *fit, *said, "-o", out, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        document = json.loads(outcome.out)
        assert document["fit"]["method"] in {"full", "color", "none"}
        assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians)
    assert (tmp_path / "0.ply").read_bytes() == (tmp_path / "1.ply").read_bytes()  # the full one, unless told


def test_a_dry_run_knows_the_most(states: list[Path], tmp_path: Path, run: Run) -> None:
    most = json.loads(run("compact", states[1], "--k", 2, "-o", tmp_path / "a.ply", "--dry-run", "--json").out)
    assert listing(tmp_path) == {}
    assert run("compact", states[1], "--k", 2, "--fit", "none", "-o", tmp_path / "a.ply").code == 0
    assert len(gsmerge.read_ply(tmp_path / "a.ply").gaussians) <= most["output"]["num_gaussians_at_most"]


@pytest.mark.slow
def test_the_papers_online_experiment(
    walks: list[Path], tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The naive way beside K = 1, 2 and 4, after each batch and in the end, by one run of one command."""
    monkeypatch.syspath_prepend(str(root / "benchmarks"))
    online = load_script(root / "benchmarks" / "online.py")
    views = read_held_out(load_scene(walks[0]), walks[0] / "targets")
    targets = online.Targets(views.images, views.cameras, np.ones(views.images.shape[:3], bool))
    monkeypatch.setattr(online, "scene_folders", lambda names: [Path(name) for name in names.split(",")])
    monkeypatch.setattr(online, "make_batches", lambda *_: [walk / "scene.ply" for walk in walks])
    monkeypatch.setattr(online, "read_held_out", lambda folder: targets)
    monkeypatch.setattr(online, "in_own_process", lambda run, *given: run(*given))
    monkeypatch.setattr(online, "lpips_available", lambda net: False)
    online.main(["one,two", "--out", str(tmp_path / "online.svg")])
    lines = capsys.readouterr().out.splitlines()
    growth, ends = json.loads(lines[1])["one"]
    assert [(views, step["naive"]) for views, step in growth.items()] == [("3", 1152), ("7", 2688)]
    for step in growth.values():
        assert step["K = 1"] <= step["groups"] < step["K = 2"] < step["K = 4"] < step["naive"]
    assert growth["3"]["groups"] < growth["7"]["groups"]
    assert {way: end["count"] for way, end in ends.items()} == {way: growth["7"][way] for way in online.WAYS}
    kept = gsmerge.Gaussians.concat([gsmerge.read_scene(walk).gaussians for walk in walks])
    assert ends["naive"]["PSNR"] == online.score(kept, targets)[0]
    rows = [line.strip("|").split("|") for line in lines if line.startswith("|")]
    assert [row[0] for row in rows[2:4]] == ["3", "7"]
    assert [row[0] for row in rows[6:]] == [scene for scene in ("one", "two", "mean") for _ in range(4)]
    assert rows[6][2:6] == rows[10][2:6] == rows[14][2:6]
    assert "</svg>" in (tmp_path / "online.svg").read_text()


# what may go wrong


@pytest.mark.parametrize("command", ["extend", "compact"])
def test_a_damaged_state_is_refused(command: str, state: Path, walks: list[Path], run: Run) -> None:
    cut(0.5)(state)
    (out := state.parent / "out.ply").write_text("precious")
    before = digests(state.parent)
    more = (walks[1],) if command == "extend" else ("-o", out, "--overwrite")
    assert_refused(run(command, state, *more), 3, state, ".gsm", "read")
    assert digests(state.parent) == before


def test_batches_before_a_broken_one_stay(states: list[Path], walks: list[Path], tmp_path: Path, run: Run) -> None:
    broken = Path(shutil.copytree(walks[1], tmp_path / "broken"))
    (broken / "scene.ply").write_bytes(b"ply\n")
    outcome = run("extend", tmp_path / "state.gsm", walks[0], broken, *SMALL)
    assert (outcome.code, outcome.err.count("\n")) == (3, 1)
    assert (tmp_path / "state.gsm").read_bytes() == states[0].read_bytes()
    assert run("extend", tmp_path / "state.gsm", walks[1]).code == 0
    assert (tmp_path / "state.gsm").read_bytes() == states[1].read_bytes()


@pytest.mark.parametrize("exists", [False, True])
def test_two_that_end_together_lose_no_batch(
    exists: bool, state: Path, walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both have read the state before either goes on; whoever may rename waits until the other may as well, or not."""
    import gsmerge.io.atomic as atomic
    import gsmerge.states.files as files

    path = state if exists else tmp_path / "new.gsm"
    before = len(load_state(path).about["batches"]) if exists else 0
    extended, renamed = files.extend, atomic._rename_all
    both_read, both_rename = threading.Barrier(2), threading.Barrier(2)

    def extend_together(*arguments: Any, **named: Any) -> Any:
        both_read.wait(PATIENCE)
        return extended(*arguments, **named)

    def rename_together(pairs: Any) -> None:
        with suppress(threading.BrokenBarrierError):
            both_rename.wait(1)
        renamed(pairs)

    monkeypatch.setattr(files, "extend", extend_together)
    monkeypatch.setattr(atomic, "_rename_all", rename_together)
    settings = {} if exists else {"superpixels": 60}
    with ThreadPoolExecutor(2) as pool:
        scenes = [find_scene_files(walk) for walk in walks]
        ends = [pool.submit(files.extend_file, path, scene, settings) for scene in scenes]
    refusals = [end.exception() for end in ends if end.exception() is not None]
    assert [type(refusal) for refusal in refusals] == [SceneError]
    assert "another process" in str(refusals[0])
    assert len(load_state(path).about["batches"]) == before + 1
    monkeypatch.undo()
    for walk, end in zip(walks, ends, strict=True):
        if end.exception() is not None:
            files.extend_file(path, find_scene_files(walk), {})
    assert len(load_state(path).about["batches"]) == before + 2
