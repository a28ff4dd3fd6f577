"""``extend`` makes states of scenes that the project makes itself, and every command takes them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage.case import Change
from damage.changes import cut
from damage.tensors import negate
from shared import make_once, write_scene

import gsmerge
from gsmerge.cli import main
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.jobs.states.extend import NOT_COMPARED
from gsmerge.jobs.states.state_file import load_state, save_state
from gsmerge.reading.read_scene import load_scene
from gsmerge.reading.scene_files import find_scene_files

from .conftest import Run, assert_refused, listing

SMALL = ("--set", "superpixels=60", "--set", "checkpoint=none")
PAPER = ("--set", "recipe=paper", "--set", "superpixels=60")


def write_walks(folder: Path) -> list[Path]:
    """Write two scenes of three and four views of 24 x 16, each a world of its own."""
    return [write_scene(folder / f"walk{n}", num_views=3 + n, width=24, height=16, seed=0) for n in range(2)]


def write_states(folder: Path) -> None:
    """Write the states after one and after two batches."""
    walks = write_walks(folder)
    assert main(["extend", str(folder / "1.gsm"), str(walks[0]), *SMALL, "--quiet"]) == 0
    shutil.copy(folder / "1.gsm", folder / "2.gsm")
    assert main(["extend", str(folder / "2.gsm"), str(walks[1]), *SMALL, "--quiet"]) == 0


@pytest.fixture(scope="session")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Yield the scenes of :func:`write_walks`. Read only, which is checked."""
    folder = tmp_path_factory.mktemp("walks")
    scenes = write_walks(folder)
    before = digests(folder)
    yield scenes
    assert digests(folder) == before


@pytest.fixture(scope="session")
def states() -> list[Path]:
    """Return the states of :func:`write_states`. Read only."""
    return [make_once("states", write_states) / name for name in ("1.gsm", "2.gsm")]


@pytest.fixture(scope="session")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return Feature Gaussians of two batches. Read only."""
    path = tmp_path_factory.mktemp("features") / "room.gsm"
    assert main(["extend", str(path), *map(str, write_walks(path.parent)), *PAPER, "--quiet"]) == 0
    return path


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """Return a state of one batch that a test may spoil."""
    (tmp_path / "work").mkdir()
    return Path(shutil.copy(make_once("states", write_states) / "1.gsm", tmp_path / "work" / "state.gsm"))


def digests(folder: Path) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()}


# batches


def test_extend_adds_several_batches_in_order(states: list[Path], walks: list[Path], tmp_path: Path, run: Run) -> None:
    """The states are those of two batches, made here for the module."""
    outcome = run("extend", tmp_path / "state.gsm", *walks, *SMALL)
    assert (outcome.code, outcome.out.count("\n")) == (0, 2), outcome.err
    first, second = outcome.out.splitlines()
    assert "state.gsm: batch 1, 3 views, 1,152 ->" in first
    assert "state.gsm: batch 2, 4 views" in second
    assert list(listing(tmp_path)) == ["state.gsm"]
    assert (tmp_path / "state.gsm").read_bytes() == states[1].read_bytes()


def test_json_of_extend_is_alone_on_stdout(walks: list[Path], tmp_path: Path, run: Run) -> None:
    state = tmp_path / "state.gsm"
    outcome = run("extend", state, *walks, *SMALL, "--json")
    assert (outcome.code, outcome.err) == (0, "")
    batches = json.loads(outcome.out)["batches"]
    assert [one["state"]["num_batches"] for one in batches] == [1, 2]
    assert batches[1]["state"]["bytes"] == state.stat().st_size
    for one, walk, num_views in zip(batches, walks, (3, 4), strict=True):
        assert one["schema_version"] == 2
        assert one["tool"]["version"] == gsmerge.__version__
        assert Path(one["input"]["path"]) == walk / "scene.ply"
        assert one["num_input"] == num_views * 24 * 16
        assert one["options"]["superpixels"] == 60
        assert {"load", "read", "write"} <= set(one["seconds"])
        assert [note for note in one["notes"] if "confirms" not in note and note != NOT_COMPARED] == []  # depth is made
    assert "import" in batches[0]["seconds"]
    assert "import" not in batches[1]["seconds"]
    kept = load_state(state).about["batches"]
    assert kept == [{name: one[name] for name in kept[0] if name != "content"} | {"content": one["input"]["content"]}
                    for one in batches]  # fmt: skip


def test_batch_is_added_once_under_any_name(states: list[Path], state: Path, walks: list[Path], run: Run) -> None:
    """Also under another name."""
    again = Path(shutil.copytree(walks[0], state.parent / "again"))
    outcome = run("extend", state, again, *SMALL, code=0)
    assert ("batch 1 of state.gsm" in outcome.err, "unchanged" in outcome.out) == (True, True)
    assert state.read_bytes() == states[0].read_bytes()


def test_dry_run_plans_the_second_batch_on_the_first_without_writing(walks: list[Path], state: Path, run: Run) -> None:
    outcome = run("extend", state.parent / "new.gsm", *walks, *SMALL, "--dry-run", code=0)
    first, second = outcome.out.splitlines()
    assert ("would be batch 1, 3 views" in first, "would be batch 2, 4 views" in second) == (True, True)
    assert second.endswith("world: not known")
    assert list(listing(state.parent)) == ["state.gsm"]


def test_inspect_lists_batches(states: list[Path], run: Run) -> None:
    listed = [line for line in run("inspect", states[1], code=0).out.splitlines() if line.startswith("batch")]
    assert ["3 views" in listed[0], "view_003.png; 1,536 ->" in listed[1]] == [True, True], listed


def test_named_cameras_and_photos_of_a_batch_are_used(state: Path, walks: list[Path], tmp_path: Path, run: Run) -> None:
    scene = Path(shutil.copytree(walks[1], tmp_path / "scene"))
    moved = shutil.move(scene / "transforms.json", tmp_path / "poses.json")
    run("extend", state, scene / "scene.ply", "--cameras", moved, "--images", scene / "images", code=0)
    assert len(load_scene(state).scene) == 7


def test_the_same_gaussians_with_other_photos_are_another_batch(
    states: list[Path], state: Path, walks: list[Path], run: Run
) -> None:
    """As who forgot the photos of a batch adds them."""
    again = Path(shutil.copytree(walks[0], state.parent / "again"))
    shutil.rmtree(again / "images")
    run("extend", state, again, *SMALL, code=0)
    assert len(load_state(state).about["batches"]) == 2


# what a state is, for the other commands: a scene


def test_every_command_takes_a_state_as_a_scene(
    states: list[Path], walks: list[Path], tmp_path: Path, run: Run
) -> None:
    """Any budget, a score, cameras beside the result, levels, other formats; without the files of the batches."""
    alone, out = Path(shutil.copy(states[1], tmp_path / "alone.gsm")), tmp_path / "out.ply"
    few = ("--budget", "40", "--set", "fit_steps=4")
    document = json.loads(run("compact", alone, *few, "--strict", "-o", out, "--json").out)
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians) == 40
    assert document["psnr_input_views"]["before"] > 15
    assert len(gsmerge.read_cameras(tmp_path / "out.cameras.json")) == 7
    for words in (
        ("compact", alone, *few, "-o", tmp_path / "small.spz"),
        ("compact", alone, *few, "-o", tmp_path / "small.html"),
        ("inspect", alone),
        ("render", alone, "-o", tmp_path / "a.png"),
        ("evaluate", alone, out, "--lpips", "none"),
        ("view", alone, out, "-o", tmp_path / "page.html", "--no-open"),
        ("convert", alone, tmp_path / "whole.ply"),
    ):
        run(*words, code=0)
    whole = gsmerge.read_ply(tmp_path / "whole.ply").gaussians
    assert len(whole) == len(load_state(alone))


def test_named_masks_of_a_state_are_used(state: Path, run: Run) -> None:
    masks = state.parent / "half"
    masks.mkdir()
    for name in read_cameras(state).names:
        (masks / f"{Path(name).stem}.png").write_bytes(
            cv2.imencode(".png", np.repeat(np.uint8([0, 255]), (8, 8))[:, None].repeat(24, 1))[1]
        )
    outcome = run("compact", state, "--masks", masks, "--effort", "draft", "-o", state.parent / "a.ply", code=0)
    assert "masks leave out 50 %" in outcome.err


def test_batch_compacts_states(state: Path, tmp_path: Path, run: Run) -> None:
    run("batch", state, "-o", tmp_path / "out", "--effort", "draft", "--jobs", "1", code=0)
    assert list((tmp_path / "out").rglob("*.ply"))


def test_state_without_a_command_makes_a_result_with_its_page(state: Path, run: Run) -> None:
    run(state, "--effort", "draft", "--quiet", code=0)
    assert {"state.compact.ply", "state.compact.compare.html"} <= set(listing(state.parent))


def test_state_file_names_no_folder_of_this_machine(states: list[Path]) -> None:
    assert str(states[0].parents[1]).encode() not in states[1].read_bytes()


def test_comments_of_the_source_are_copied_as_by_compact(state: Path, tmp_path: Path, run: Run) -> None:
    """How to render the Gaussians, and nothing else: neither cameras nor megabytes."""
    held, out = load_state(state), tmp_path / "out.ply"
    long = [f"SplatRenderMode: {i:01000}" for i in range(2000)]
    cameras = ["gsmerge cameras: AAAA", "of no use", 5, None, "SplatRenderMode: mip\nelement vertex 1"]
    about = {**held.about, "comments": [*long, *cameras, "SplatRenderMode: mip"]}
    save_state(state, replace(held, about=about), overwrite=True)
    run("compact", state, "--effort", "draft", "-o", out, code=0)
    comments = [line for line in gsmerge.read_ply(out).info.comments if not line.startswith("gsmerge cameras")]
    assert comments == ["gsmerge result", "SplatRenderMode: mip"]


# Feature Gaussians


@pytest.mark.parametrize("k", ["1", "4", "mixed"])
def test_feature_gaussians_are_decoded(k: str, features: Path, tmp_path: Path, run: Run) -> None:
    out, words = tmp_path / "a.ply", ("--k", k, "-o", tmp_path / "a.ply")
    most = json.loads(run("compact", features, *words, "--dry-run", "--json", code=0).out)["output"]
    assert listing(tmp_path) == {}
    document = json.loads(run("compact", features, *words, "--json", code=0).out)
    assert document["input"]["num_gaussians"] == 7 * 24 * 16
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians) <= most["num_gaussians_at_most"]
    assert set(document["seconds"]) == {"import", "read", "decode", "write"}
    assert len(gsmerge.read_cameras(tmp_path / "a.cameras.json")) == 7
    assert "Feature Gaussians ->" in run("compact", features, *words, "--overwrite", code=0).out


@pytest.mark.parametrize(
    ("out", "files"), [("a.sog", {"a.sog", "a.cameras.json", "a.settings.json"}), ("a.html", {"a.html"})]
)
def test_feature_gaussians_in_every_kind_of_output(
    out: str, files: set[str], features: Path, tmp_path: Path, run: Run
) -> None:
    document = json.loads(run("compact", features, "-o", tmp_path / out, "--json", code=0).out)
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()} == files
    assert document["output"]["bytes"] == sum(
        (tmp_path / name).stat().st_size for name in files if not name.endswith(".json")
    )


def test_feature_gaussians_refuse_results_they_cannot_make(
    features: Path, states: list[Path], tmp_path: Path, run: Run
) -> None:
    for words, place, *found in (
        (("compact", features, "--budget", "10"), "--budget", features),
        (("compact", features, states[0], "-o", tmp_path / "a.ply"), features, "only input", 2),
        (("compact", features, "--k", "8", "-o", tmp_path / "a.ply"), "k", "1 to 4"),
    ):
        assert_refused(run(*words), 2, place, *found)
    assert_refused(run("convert", features, tmp_path / "a.ply"), 3, features, "results", "Feature Gaussians")
    assert listing(tmp_path) == {}


# what may go wrong


@pytest.mark.parametrize("spoil", [cut(0.5), negate("sh0")], ids=["half", "a changed byte"])
def test_damaged_state_is_refused_by_every_command(spoil: Change, state: Path, walks: list[Path], run: Run) -> None:
    spoil(state)
    (out := state.parent / "out.ply").write_text("precious")
    before = digests(state.parent)
    for words in (
        ("extend", state, walks[1]), ("compact", state, "-o", out, "--overwrite"), ("inspect", state),
        ("convert", state, out, "--overwrite"),
    ):  # fmt: skip
        assert_refused(run(*words), 3, state)
    assert digests(state.parent) == before


def test_batches_before_a_broken_one_stay_in_the_state(
    states: list[Path], walks: list[Path], tmp_path: Path, run: Run
) -> None:
    broken = Path(shutil.copytree(walks[1], tmp_path / "broken"))
    (broken / "scene.ply").write_bytes(b"ply\n")
    outcome = run("extend", tmp_path / "state.gsm", walks[0], broken, *SMALL)
    *notes, error = outcome.err.splitlines()
    assert (outcome.code, error.startswith("gsmerge: error: ")) == (3, True)
    assert all("confirms" in note for note in notes)  # depth that is made up
    assert (tmp_path / "state.gsm").read_bytes() == states[0].read_bytes()
    run("extend", tmp_path / "state.gsm", walks[1], *SMALL, code=0)
    assert (tmp_path / "state.gsm").read_bytes() == states[1].read_bytes()


@pytest.mark.parametrize("exists", [False, True])
def test_two_extensions_at_once_lose_no_batch(exists: bool, state: Path, walks: list[Path], tmp_path: Path) -> None:
    """The second waits for the first, and adds to what that one has made."""
    from gsmerge.jobs.states.files import extend_file

    path = state if exists else tmp_path / "new.gsm"
    before = len(load_state(path).about["batches"]) if exists else 0
    scenes = [walks[1], write_scene(tmp_path / "third", num_views=2, width=24, height=16, seed=0)]
    with ThreadPoolExecutor(2) as pool:
        found = [find_scene_files(scene) for scene in scenes]
        ends = [pool.submit(extend_file, path, scene, {"superpixels": 60}) for scene in found]
    assert [end.exception() for end in ends] == [None, None]
    assert len(load_state(path).about["batches"]) == before + 2
    assert not [name for name in listing(path.parent) if name.endswith(".lock")]
