"""A state of one batch, compacted as its scene is, and outputs in other formats."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hostile.gsm_files import Spoil, damaged, with_about
from network_fixtures import SMALL as TINY
from network_fixtures import noisy, written
from sweeps import sweep

import gsmerge

from .conftest import Run, assert_refused

SMALL = ("--set", "superpixels=120")


PLAIN = ("--fit", "none")


@pytest.fixture(scope="module")
def state(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The made scene as a state, by the command line. Read only."""
    from gsmerge.cli import main

    out = tmp_path_factory.mktemp("state") / "scene.gsm"
    assert main(["extend", str(out), str(small_scene), *map(str, SMALL), "--quiet"]) == 0
    return out


@pytest.mark.parametrize("recipe", [False, True])
def test_it_is_compacted_as_its_scene_is(
    recipe: bool, state: Path, small_scene: Path, tmp_path: Path, run: Run
) -> None:
    """Byte for byte, for every K."""
    wish = PLAIN
    if recipe:
        options = replace(TINY, outputs="absolute", geometry="carried", merger_start="first", group_numbers=False)
        checkpoint = written(tmp_path / "small.safetensors", noisy(options, 0.05))
        wish, state = ("--set", "recipe=paper", "--set", f"checkpoint={checkpoint}"), tmp_path / "scene.gsm"
        assert run("extend", state, small_scene, *SMALL, *wish).code == 0
    sizes = set[int]()
    for k in (1, 2, 4, "mixed"):
        one, other = tmp_path / f"one{k}.ply", tmp_path / f"other{k}.ply"
        assert run("compact", state, *PLAIN, "--k", k, "-o", one).code == 0
        assert run("compact", small_scene, *SMALL, *wish, "--k", k, "-o", other).code == 0
        assert one.read_bytes() == other.read_bytes(), k
        sizes.add(one.stat().st_size)
    assert len(sizes) == 4


def test_mixed_k_in_other_shares(state: Path, small_scene: Path, tmp_path: Path, run: Run) -> None:
    one, other = tmp_path / "one.ply", tmp_path / "other.ply"
    wish = ("--k", "mixed", "--set", "k_low=20", "--set", "k_rule=distortion")
    assert run("compact", state, *PLAIN, *wish, "-o", one).code == 0
    assert run("compact", small_scene, *PLAIN, *SMALL, *wish, "-o", other).code == 0
    assert one.read_bytes() == other.read_bytes()


@sweep(
    "wish",
    [("budget=700", "k=2"), ("k=mixed",), ("budget=auto",), ("recipe=paper",), ("budget=3%",)],
    ids=str,
    often=3,
)
def test_what_the_batch_was_asked_for_is_the_default(
    wish: tuple[str, ...], small_scene: Path, tmp_path: Path, run: Run
) -> None:
    wish = tuple(word for pair in wish for word in ("--set", pair))
    kept, one, other = tmp_path / "scene.gsm", tmp_path / "one.ply", tmp_path / "other.ply"
    assert run("extend", kept, small_scene, *SMALL, *wish).code == 0
    assert run("compact", kept, *PLAIN, "-o", one).code == 0
    assert run("compact", small_scene, *PLAIN, *SMALL, *wish, "-o", other).code == 0
    assert one.read_bytes() == other.read_bytes()


def test_feature_gaussians_as_arrays(state: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "features.npz"
    document = json.loads(run("convert", state, out, "--json", code=0).out)
    with np.load(out) as arrays:
        count = len(arrays["means"])
        assert {name: list(array.shape) for name, array in arrays.items()} == document["output"]["arrays"]
    assert (document["output"]["num_groups"], document["output"]["bytes"]) == (count, out.stat().st_size)
    assert_refused(run("convert", state, out), 2, "features.npz", "--overwrite")
    assert f"{count:,} Feature Gaussians" in run("convert", state, out, "--overwrite", code=0).out
    assert run("convert", state, out, "--overwrite", "--quiet", code=0).out == ""


@pytest.mark.parametrize(
    ("more", "name", "found"),
    [((), "a.ply", "a.ply"), (("--up", "z"), "a.npz", "--up"), (("--cameras", "a.json"), "a.npz", "--cameras")],
)
def test_a_state_is_converted_as_it_is(
    more: tuple[str, ...], name: str, found: str, state: Path, tmp_path: Path, run: Run
) -> None:
    assert_refused(run("convert", state, tmp_path / name, *more), 2, found, "state")
    assert not list(tmp_path.iterdir())


def test_a_state_is_converted_alone(state: Path, tmp_path: Path, run: Run) -> None:
    assert_refused(run("convert", state, state, tmp_path / "a.npz"), 2, state, "alone", 2)


def test_a_state_is_no_web_site(state: Path, tmp_path: Path, run: Run) -> None:
    assert_refused(run("compact", state, "-o", tmp_path / "site"), 2, tmp_path / "site", state, "convert")
    damaged = tmp_path / "a.gsm"
    damaged.write_bytes(state.read_bytes()[:1000])
    assert_refused(run("convert", damaged, tmp_path / "a.npz"), 3, "a.gsm")


def test_no_files_of_the_scene_are_needed(small_copy: Path, tmp_path: Path, run: Run) -> None:
    assert run("extend", small_copy / "scene.gsm", small_copy / "scene.ply", *SMALL).code == 0
    kept = shutil.move(small_copy / "scene.gsm", tmp_path / "alone.gsm")
    shutil.rmtree(small_copy)
    outcome = run("compact", kept, *PLAIN, code=0)
    assert outcome.out.count("\n") == 1
    assert "groups ->" in outcome.out
    assert len(gsmerge.read_ply(tmp_path / "alone.compact.ply").gaussians) > 100


def test_the_reports(small_scene: Path, tmp_path: Path, run: Run) -> None:
    kept, out = tmp_path / "scene.gsm", tmp_path / "out.ply"
    (document,) = json.loads(run("extend", kept, small_scene, *SMALL, "--json").out)["batches"]
    digest = hashlib.sha256((small_scene / "scene.ply").read_bytes()).hexdigest()
    assert document["num_input"] == 7_680
    assert document["state"]["bytes"] == kept.stat().st_size
    document = json.loads(run("compact", kept, *PLAIN, "--k", 2, "-o", out, "--json").out)
    assert document["input"]["num_gaussians"] == 7_680
    assert document["input"]["state"]["source"]["sha256"] == digest
    assert document["input"]["state"]["source"]["name"] == "scene.ply"
    assert document["output"]["bytes"] == out.stat().st_size
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians)
    assert set(document["seconds"]) == {"import", "read", "decode", "write"}


def test_no_folder_of_this_machine_is_in_the_file(state: Path, small_scene: Path) -> None:
    assert str(small_scene.parent).encode() not in state.read_bytes()


def test_comments_of_the_source_are_copied_as_by_compact(state: Path, tmp_path: Path, run: Run) -> None:
    """How to render the Gaussians, and nothing else: neither cameras nor megabytes."""
    path, out = Path(shutil.copy(state, tmp_path / "scene.gsm")), tmp_path / "out.ply"
    long = [f"SplatRenderMode: {i:01000}" for i in range(2000)]
    cameras = ["gsmerge cameras: AAAA", "of no use", 5, None, "SplatRenderMode: mip\nelement vertex 1"]
    with_about(source={"comments": [*long, *cameras, "SplatRenderMode: mip"]})(path)
    run("compact", path, *PLAIN, "-o", out, code=0)
    assert gsmerge.read_ply(out).info.comments == ("gsmerge result", "SplatRenderMode: mip")
    run("inspect", out, code=0)


@sweep("ending", [".spz", ".sog", ".splat", ".glb"], often=2)
def test_other_formats_by_name(ending: str, state: Path, small_scene: Path, tmp_path: Path, run: Run) -> None:
    one, other = tmp_path / f"one{ending}", tmp_path / f"other{ending}"
    assert run("compact", state, *PLAIN, "-o", one).code == 0
    document = json.loads(run("compact", small_scene, "--fit", "none", *SMALL, "-o", other, "--json").out)
    assert one.read_bytes() == other.read_bytes()
    assert document["output"]["bytes"] == other.stat().st_size
    assert not one.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\ncomment opacity")


@sweep("ending", [".sog", ".spz", ".splat"])
def test_results_are_read_in_any_format(ending: str, small_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / f"a{ending}"
    assert run("compact", small_scene, "--fit", "none", *SMALL, "-o", out).code == 0
    inspected = json.loads(run("inspect", out, "--json").out)
    assert inspected["bytes"] == out.stat().st_size
    assert run("render", small_scene, out, "-o", tmp_path / "a.png").code == 0
    table = run("evaluate", small_scene, out, "--lpips", "none").out
    assert f"a{ending}" in table


@sweep("ending", [".spz", ".splat"])
def test_one_per_pixel_in_other_formats(ending: str, small_scene: Path, tmp_path: Path, run: Run) -> None:
    whole, out = tmp_path / f"whole{ending}", tmp_path / "out.ply"
    gsmerge.write_gaussians(whole, gsmerge.read_scene(small_scene).gaussians)
    places = ("--cameras", small_scene / "transforms.json", "--images", small_scene / "images")
    outcome = run("compact", whole, *places, "--fit", "none", *SMALL, "-o", out, "--json", code=0)
    assert json.loads(outcome.out)["output"]["num_gaussians"] > 10


def test_no_normals(state: Path, tmp_path: Path, run: Run) -> None:
    sizes = []
    for name, extra in {"a": (), "b": ("--set", "normals=false")}.items():
        assert run("compact", state, *PLAIN, "-o", tmp_path / f"{name}.ply", *extra).code == 0
        sizes.append(gsmerge.read_ply(tmp_path / f"{name}.ply").info)
    assert sizes[0].bytes_by_attribute["normals"] == 12 * sizes[0].count
    assert "normals" not in sizes[1].bytes_by_attribute
    assert sizes[1].count == sizes[0].count


@pytest.mark.parametrize(
    ("spoil", "found"),
    [(damaged("features.sh0"), "features.sh0"), (with_about(options={"neighbors": 10**9}), "neighbors")],
    ids=["damaged", "a setting without end"],
)
def test_what_nobody_wrote_is_refused_by_all(
    spoil: Spoil, found: str, state: Path, small_scene: Path, tmp_path: Path, run: Run
) -> None:
    path = Path(shutil.copy(state, tmp_path / "scene.gsm"))
    spoil(path)
    before = path.read_bytes()
    for command in (
        ("compact", path, "-o", tmp_path / "out.ply"),
        ("convert", path, tmp_path / "out.npz"),
        ("extend", path, small_scene),
        ("inspect", path),
    ):
        assert found in run(*command, code=3).err
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["scene.gsm"]
