"""``extend``, and ``compact`` of states, on scenes that the project makes itself; and whatever may happen meanwhile."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import threading
import time
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

from .conftest import Outcome, Run, assert_refused, listing

SMALL = ("--set", "superpixels=60", "--set", "checkpoint=none")
PATIENCE = 120  # seconds, on a machine that is busy with other things


@pytest.fixture(scope="session")
def walks(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Two scenes of the same room, three and four views of 48 x 32. Read only, which is checked."""
    folder = tmp_path_factory.mktemp("walks")
    scenes = [make_scene(folder / f"walk{n}", num_views=3 + n, width=48, height=32, seed=0) for n in range(2)]
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
    outcome = run("extend", tmp_path / "state.gsm", *walks, *SMALL)
    assert (outcome.code, outcome.out.count("\n")) == (0, 2), outcome.err
    first, second = outcome.out.splitlines()
    assert "state.gsm: batch 1, 3 views, 4,608 Gaussians ->" in first
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
        assert one["num_input"] == num_views * 48 * 32
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
    said = (
        *SMALL,
        "--set",
        "fit_colors=false",
        "--set",
        "tolerance=0",
        "--set",
        "max_k=2",
        "--set",
        "replay=2",
        "--set",
        "seed=5",
    )
    assert run("extend", state, walks[0], *said).code == 0
    first = load_state(state).about["options"]
    document = json.loads(run("extend", state, walks[1], "--json").out)["batches"][0]
    assert document["num_covered"] == 0
    same = {"superpixels": 60, "fit_colors": False, "tolerance": 0.0, "max_k": 2, "replay": 2, "seed": 5}
    assert same.items() <= first.items()
    assert same.items() <= document["options"].items()
    assert len(load_state(state).replay) <= 2
    document = json.loads(run("extend", state, walks[0], "--set", "tolerance=0.5", "--json").out)["batches"][0]
    assert (document["options"]["tolerance"], document["options"]["superpixels"]) == (0.5, 60)
    assert document["num_covered"] > 0


def test_cameras_of_one_batch(state: Path, walks: list[Path], tmp_path: Path, run: Run) -> None:
    scene = Path(shutil.copytree(walks[1], tmp_path / "scene"))
    moved = shutil.move(scene / "transforms.json", tmp_path / "poses.json")
    said = ("--cameras", moved, "--images", scene / "images")
    assert run("extend", state, scene / "scene.ply", *said).code == 0


# decoding


def test_every_number_that_can_be_decoded(states: list[Path], tmp_path: Path, run: Run) -> None:
    groups, actual = len(load_state(states[1])), []
    for k in (1, 2, 4):
        outcome = run("compact", states[1], "--k", k, "--fit", "none", "-o", tmp_path / f"{k}.ply")
        assert (outcome.code, outcome.out.count("\n")) == (0, 1), outcome.err
        actual.append(len(gsmerge.read_ply(tmp_path / f"{k}.ply").gaussians))
    assert actual == sorted(actual)
    assert actual[0] <= groups < actual[2] <= 4 * groups
    said = ("--budget", groups + 40, "--fit", "none", "-o", tmp_path / "b.ply", "--json")
    document = json.loads(run("compact", states[1], *said).out)
    assert groups < document["output"]["num_gaussians"] <= groups + 40
    assert (document["budget"], document["fit"]) == (str(groups + 40), None)
    assert document["input"]["num_groups"] == groups
    assert document["input"]["num_gaussians"] == 7 * 48 * 32


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


# groups that keep their latents


@pytest.fixture(scope="session")
def latents(walks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state after two batches with the paper's networks. Read only."""
    path = tmp_path_factory.mktemp("latents") / "state.gsm"
    assert (
        main(["extend", str(path), str(walks[0]), "--set", "recipe=paper", "--set", "superpixels=60", "--quiet"]) == 0
    )
    assert main(["extend", str(path), str(walks[1]), "--quiet"]) == 0
    return path


def test_the_heads_run_when_they_are_asked(latents: Path, tmp_path: Path, run: Run) -> None:
    state, counts = load_state(latents), []
    assert state.networks is not None
    assert len(state.about["batches"]) == 2
    for k in (1, 2, 4):
        outcome = run("compact", latents, "--k", k, "-o", tmp_path / f"{k}.ply", "--json", code=0)
        assert json.loads(outcome.out)["fit"] is None  # no photos are stored
        counts.append(len(gsmerge.read_ply(tmp_path / f"{k}.ply").gaussians))
    assert counts[0] < counts[1] < counts[2] <= 4 * len(state)
    assert run("inspect", latents, code=0).out.startswith("ok ")


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
    assert [(views, step["naive"]) for views, step in growth.items()] == [("3", 4608), ("7", 10752)]
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


def test_networks_of_another_state(latents: Path, walks: list[Path], tmp_path: Path, run: Run) -> None:
    state = Path(shutil.copy(latents, tmp_path / "state.gsm"))
    outcome = run("extend", state, walks[0], "--set", "checkpoint=shipped")
    assert_refused(outcome, 2, "checkpoint shipped", "(paper)", "state")
    assert state.read_bytes() == latents.read_bytes()


# wrong usage


def test_harmonics_of_another_degree(state: Path, walks: list[Path], tmp_path: Path, run: Run) -> None:
    from dataclasses import replace

    import numpy as np

    scene = Path(shutil.copytree(walks[1], tmp_path / "scene"))
    have = gsmerge.read_ply(scene / "scene.ply").gaussians
    degree = 1 if have.sh_degree == 0 else 0
    other = replace(have, shN=np.zeros((len(have), (degree + 1) ** 2 - 1, 3), np.float32))
    gsmerge.write_ply(scene / "scene.ply", other, overwrite=True)
    before = state.read_bytes()
    assert_refused(run("extend", state, scene), 2, "", f"degree {have.sh_degree}", f"degree {degree}")
    assert state.read_bytes() == before


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


def test_a_broken_first_batch_makes_no_file(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    (scene_copy / "scene.ply").write_bytes(b"")
    outcome = run("extend", tmp_path / "state.gsm", scene_copy)
    assert_refused(outcome, 3, scene_copy / "scene.ply", "PLY")
    assert not (tmp_path / "state.gsm").exists()
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_state_that_another_process_changes_meanwhile(
    state: Path, states: list[Path], walks: list[Path], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    import gsmerge.states.files as files

    extended = files.extend

    def slowly(*arguments: object, **named: object) -> object:
        done = extended(*arguments, **named)  # type: ignore[arg-type]
        shutil.copy(states[1], state.parent / "other.gsm")
        (state.parent / "other.gsm").replace(state)
        return done

    monkeypatch.setattr(files, "extend", slowly)
    assert_refused(run("extend", state, walks[1]), 3, state, "process")
    assert state.read_bytes() == states[1].read_bytes()
    assert list(listing(state.parent)) == ["state.gsm"]


def test_a_state_that_another_process_makes_meanwhile(
    states: list[Path], walks: list[Path], tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    import gsmerge.states.files as files

    extended, state = files.extend, tmp_path / "state.gsm"

    def slowly(*arguments: object, **named: object) -> object:
        shutil.copy(states[1], state)
        return extended(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(files, "extend", slowly)
    assert_refused(run("extend", state, walks[0], *SMALL), 3, state, "process")
    assert state.read_bytes() == states[1].read_bytes()


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


@pytest.mark.skipif(sys.platform != "linux", reason="limits of files as Linux has them")
def test_a_full_disk_leaves_the_old_state(state: Path, states: list[Path], walks: list[Path], run: Run) -> None:
    """No file may grow beyond a size, as on a disk that fills up."""
    limit = state.stat().st_size // 2
    code = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
    code += "import sys; from gsmerge.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "extend", str(state), str(walks[1])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert_refused(Outcome(done.returncode, done.stdout, done.stderr), 3, state, "File too large")
    assert list(listing(state.parent)) == ["state.gsm"]
    assert state.read_bytes() == states[0].read_bytes()
    assert run("extend", state, walks[1]).code == 0
    assert state.read_bytes() == states[1].read_bytes()


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="signals as Linux has them")
@pytest.mark.slow
def test_killed_in_the_middle(state: Path, states: list[Path], walks: list[Path], run: Run) -> None:
    """While it works, then right when it writes: the old state stays whole, and a rerun gives the usual bytes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "gsmerge", "extend", str(state), str(walks[1]), "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    deadline = time.monotonic() + PATIENCE
    while len(listing(state.parent)) == 1 and process.poll() is None:  # until the temporary file is there
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert state.read_bytes() == states[0].read_bytes()
    code = (
        "import os, signal, sys\n"
        "import gsmerge.states.files as files\n"
        "from gsmerge.cli import main\n"
        "saved = files.save_state\n"
        "def save(path, state, **named):\n"
        "    saved(path, state, **named)\n"
        "    os.truncate(path, 1000)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "files.save_state = save\n"
        "main(sys.argv[1:])"
    )
    done = subprocess.run([sys.executable, "-c", code, "extend", str(state), str(walks[1])], check=False)
    assert done.returncode == -signal.SIGKILL
    assert state.read_bytes() == states[0].read_bytes()
    assert run("extend", state, walks[1]).code == 0
    assert state.read_bytes() == states[1].read_bytes()
