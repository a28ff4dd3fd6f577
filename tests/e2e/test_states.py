"""A state of one batch, compacted as its scene is, and outputs in other formats."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hostile.gsm_files import Spoil, damaged, with_about
from sweeps import sweep

import gsmerge

from .conftest import Run, assert_refused

SMALL = ("--set", "superpixels=40")
PLAIN = ("--fit", "none")


@pytest.fixture(scope="module")
def state(smallest_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The made scene as a state, by the command line. Read only."""
    from gsmerge.cli import main

    out = tmp_path_factory.mktemp("state") / "scene.gsm"
    assert main(["extend", str(out), str(smallest_scene), *map(str, SMALL), "--quiet"]) == 0
    return out


def test_it_is_compacted_as_its_scene_is(state: Path, smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    """Byte for byte; unless told otherwise with what the batch was asked for."""
    asked, wish = tmp_path / "asked.gsm", ("--set", "budget=100", "--set", "k=2")
    run("extend", asked, smallest_scene, *SMALL, *wish, code=0)
    mixed = ("--k", "mixed", "--set", "k_low=20", "--set", "k_rule=distortion")
    for number, (kept, now, then) in enumerate(((state, mixed, mixed), (asked, (), wish))):
        one, other = tmp_path / f"one{number}.ply", tmp_path / f"other{number}.ply"
        run("compact", kept, *PLAIN, *now, "-o", one, code=0)
        run("compact", smallest_scene, *PLAIN, *SMALL, *then, "-o", other, code=0)
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


def test_what_a_state_is_not_made_into(state: Path, tmp_path: Path, run: Run) -> None:
    for more, name, found in (
        ((), "a.ply", "a.ply"), (("--up", "z"), "a.npz", "--up"), (("--cameras", "a.json"), "a.npz", "--cameras"),
    ):  # fmt: skip
        assert_refused(run("convert", state, tmp_path / name, *more), 2, found, "state")
    assert_refused(run("convert", state, state, tmp_path / "a.npz"), 2, state, "alone", 2)
    assert_refused(run("compact", state, "-o", tmp_path / "site"), 2, tmp_path / "site", state, "convert")
    assert not list(tmp_path.iterdir())
    damaged = tmp_path / "a.gsm"
    damaged.write_bytes(state.read_bytes()[:1000])
    assert_refused(run("convert", damaged, tmp_path / "a.npz"), 3, "a.gsm")


def test_no_files_of_the_scene_are_needed(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    scene, kept = Path(shutil.copytree(smallest_scene, tmp_path / "scene")), tmp_path / "alone.gsm"
    run("extend", kept, scene / "scene.ply", *SMALL, code=0)
    shutil.rmtree(scene)
    outcome = run("compact", kept, *PLAIN, code=0)
    assert outcome.out.count("\n") == 1
    assert "groups ->" in outcome.out
    assert len(gsmerge.read_ply(tmp_path / "alone.compact.ply").gaussians) > 50


def test_the_reports(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    kept, out = tmp_path / "scene.gsm", tmp_path / "out.ply"
    (document,) = json.loads(run("extend", kept, smallest_scene, *SMALL, "--json").out)["batches"]
    digest = hashlib.sha256((smallest_scene / "scene.ply").read_bytes()).hexdigest()
    assert document["num_input"] == 1_152
    assert document["state"]["bytes"] == kept.stat().st_size
    document = json.loads(run("compact", kept, *PLAIN, "--k", 2, "-o", out, "--json").out)
    assert document["input"]["num_gaussians"] == 1_152
    assert document["input"]["state"]["source"]["sha256"] == digest
    assert document["input"]["state"]["source"]["name"] == "scene.ply"
    assert document["output"]["bytes"] == out.stat().st_size
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians)
    assert set(document["seconds"]) == {"import", "read", "decode", "write"}


def test_no_folder_of_this_machine_is_in_the_file(state: Path, smallest_scene: Path) -> None:
    assert str(smallest_scene.parent).encode() not in state.read_bytes()


def test_comments_of_the_source_are_copied_as_by_compact(state: Path, tmp_path: Path, run: Run) -> None:
    """How to render the Gaussians, and nothing else: neither cameras nor megabytes."""
    path, out = Path(shutil.copy(state, tmp_path / "scene.gsm")), tmp_path / "out.ply"
    long = [f"SplatRenderMode: {i:01000}" for i in range(2000)]
    cameras = ["gsmerge cameras: AAAA", "of no use", 5, None, "SplatRenderMode: mip\nelement vertex 1"]
    with_about(source={"comments": [*long, *cameras, "SplatRenderMode: mip"]})(path)
    run("compact", path, *PLAIN, "-o", out, code=0)
    assert gsmerge.read_ply(out).info.comments == ("gsmerge result", "SplatRenderMode: mip")
    run("inspect", out, code=0)


@sweep("ending", [".sog", ".spz", ".splat", ".glb"])
def test_other_formats_by_name(ending: str, state: Path, smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    one, other = tmp_path / f"one{ending}", tmp_path / f"other{ending}"
    run("compact", state, *PLAIN, "-o", one, code=0)
    document = json.loads(run("compact", smallest_scene, "--fit", "none", *SMALL, "-o", other, "--json").out)
    assert one.read_bytes() == other.read_bytes()
    assert document["output"]["bytes"] == other.stat().st_size
    assert not one.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\ncomment opacity")
    assert json.loads(run("inspect", other, "--json").out)["bytes"] == other.stat().st_size
    run("render", smallest_scene, other, "-o", tmp_path / "a.png", code=0)
    assert f"other{ending}" in run("evaluate", smallest_scene, other, "--lpips", "none").out


def test_one_per_pixel_in_another_format(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    whole, out = tmp_path / "whole.spz", tmp_path / "out.ply"
    gsmerge.write_gaussians(whole, gsmerge.read_scene(smallest_scene).gaussians)
    places = ("--cameras", smallest_scene / "transforms.json", "--images", smallest_scene / "images")
    run("compact", whole, *places, "--fit", "none", *SMALL, "-o", out, code=0)
    assert len(gsmerge.read_ply(out).gaussians) > 10


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
    spoil: Spoil, found: str, state: Path, smallest_scene: Path, tmp_path: Path, run: Run
) -> None:
    path = Path(shutil.copy(state, tmp_path / "scene.gsm"))
    spoil(path)
    before = path.read_bytes()
    for command in (
        ("compact", path, "-o", tmp_path / "out.ply"),
        ("convert", path, tmp_path / "out.npz"),
        ("extend", path, smallest_scene),
        ("inspect", path),
    ):
        assert found in run(*command, code=3).err
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["scene.gsm"]
