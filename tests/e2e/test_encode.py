"""``encode`` and ``decode`` on a scene that the project makes itself, and outputs in other formats."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from hostile.gsm_files import with_about

import gsmerge

from .conftest import Run, assert_refused

SMALL = ("--superpixels", 120)


@pytest.fixture(scope="module")
def encoded(made_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The made scene, encoded by the command line. Read only."""
    from gsmerge.cli import main

    out = tmp_path_factory.mktemp("encoded") / "scene.gsm"
    assert main(["encode", str(made_scene), "-o", str(out), *map(str, SMALL), "--quiet"]) == 0
    return out


@pytest.mark.parametrize("k", [1, 2, 4])
def test_decoded_is_compacted_byte_for_byte(k: int, encoded: Path, made_scene: Path, tmp_path: Path, run: Run) -> None:
    one, other = tmp_path / "one.ply", tmp_path / "other.ply"
    assert run("decode", encoded, "--k", k, "-o", one).code == 0
    assert run("compact", made_scene, "--fit", "none", *SMALL, "--k", k, "-o", other).code == 0
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("wish", [("--budget", "3%"), ("--budget", "700", "--k", "2"), ("--budget", "auto")], ids=str)
def test_what_encoding_was_asked_for_is_what_decoding_gives(
    wish: tuple[str, ...], made_scene: Path, tmp_path: Path, run: Run
) -> None:
    kept, one, other = tmp_path / "scene.gsm", tmp_path / "one.ply", tmp_path / "other.ply"
    assert run("encode", made_scene, *SMALL, *wish, "-o", kept).code == 0
    assert run("decode", kept, "-o", one).code == 0
    assert run("compact", made_scene, "--fit", "none", *SMALL, *wish, "-o", other).code == 0
    assert one.read_bytes() == other.read_bytes()


def test_no_images_are_needed(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    assert run("encode", scene_copy / "scene.ply", *SMALL).code == 0
    kept = shutil.move(scene_copy / "scene.gsm", tmp_path / "alone.gsm")
    shutil.rmtree(scene_copy)
    outcome = run("decode", kept, code=0)
    assert outcome.out.count("\n") == 1
    assert "groups ->" in outcome.out
    assert len(gsmerge.read_ply(tmp_path / "alone.compact.ply").gaussians) > 100


def test_encoding_twice_gives_the_same_bytes(encoded: Path, made_scene: Path, tmp_path: Path, run: Run) -> None:
    again = tmp_path / "again.gsm"
    assert run("encode", made_scene, *SMALL, "-o", again, "--threads", 1).code == 0
    assert again.read_bytes() == encoded.read_bytes()


def test_a_budget_at_decoding_is_met(encoded: Path, tmp_path: Path, run: Run) -> None:
    actual = gsmerge.load_encoded(encoded)
    outcome = run("decode", encoded, "--budget", len(actual) + 100, "-o", tmp_path / "a.ply", "--json")
    document = json.loads(outcome.out)
    assert document["budget"] == str(len(actual) + 100)
    assert len(actual) <= document["output"]["num_gaussians"] <= len(actual) + 100


def test_the_reports(made_scene: Path, tmp_path: Path, run: Run) -> None:
    kept, out = tmp_path / "scene.gsm", tmp_path / "out.ply"
    document = json.loads(run("encode", made_scene, *SMALL, "-o", kept, "--json").out)
    digest = hashlib.sha256((made_scene / "scene.ply").read_bytes()).hexdigest()
    assert document["input"]["sha256"] == digest
    assert document["input"]["num_gaussians"] == 30_720
    assert document["output"]["bytes"] == kept.stat().st_size
    assert document["output"]["max_k"] == 4
    assert document["ratio_bytes"] == pytest.approx(kept.stat().st_size / (made_scene / "scene.ply").stat().st_size)
    assert set(document["seconds"]) == {"import", "read", "encode", "write"}
    document = json.loads(run("decode", kept, "--k", 2, "-o", out, "--json").out)
    assert document["input"]["encoding"]["source"]["sha256"] == digest
    assert document["input"]["encoding"]["source"]["name"] == "scene.ply"
    assert document["output"]["bytes"] == out.stat().st_size
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians)
    assert set(document["seconds"]) == {"import", "read", "decode", "write"}


def test_no_folder_of_this_machine_is_in_the_file(encoded: Path, made_scene: Path) -> None:
    assert str(made_scene.parent).encode() not in encoded.read_bytes()


def test_half_a_file_is_refused_and_nothing_is_lost(encoded: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "scene.gsm").write_bytes(encoded.read_bytes()[:-100])
    (tmp_path / "out.ply").write_text("precious")
    outcome = run("decode", tmp_path / "scene.gsm", "-o", tmp_path / "out.ply", "--overwrite")
    assert_refused(outcome, 3, tmp_path / "scene.gsm", "encode")
    assert (tmp_path / "out.ply").read_text() == "precious"


def test_comments_of_the_source_are_copied_as_by_compact(encoded: Path, tmp_path: Path, run: Run) -> None:
    """How to render the Gaussians, and nothing else: neither cameras nor megabytes."""
    path, out = Path(shutil.copy(encoded, tmp_path / "scene.gsm")), tmp_path / "out.ply"
    long = [f"SplatRenderMode: {i:01000}" for i in range(2000)]
    cameras = ["gsmerge cameras: AAAA", "of no use", 5, None, "SplatRenderMode: mip\nelement vertex 1"]
    with_about(source={"comments": [*long, *cameras, "SplatRenderMode: mip"]})(path)
    run("decode", path, "-o", out, code=0)
    assert gsmerge.read_ply(out).info.comments == ("gsmerge result", "SplatRenderMode: mip")
    run("check", out, code=0)


@pytest.mark.parametrize("ending", [".compressed.ply", ".spz", ".sog", ".splat", ".glb"])
def test_other_formats_by_name(ending: str, encoded: Path, made_scene: Path, tmp_path: Path, run: Run) -> None:
    one, other = tmp_path / f"one{ending}", tmp_path / f"other{ending}"
    assert run("decode", encoded, "-o", one).code == 0
    document = json.loads(run("compact", made_scene, "--fit", "none", *SMALL, "-o", other, "--json").out)
    assert one.read_bytes() == other.read_bytes()
    assert document["output"]["bytes"] == other.stat().st_size
    assert not one.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\ncomment opacity")


@pytest.mark.parametrize("ending", [".compressed.ply", ".spz", ".sog", ".splat"])
def test_results_are_read_in_any_format(ending: str, made_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / f"a{ending}"
    assert run("compact", made_scene, "--fit", "none", *SMALL, "-o", out).code == 0
    inspected = json.loads(run("inspect", out, "--json").out)
    assert inspected["bytes"] == out.stat().st_size
    assert run("render", made_scene, out, "-o", tmp_path / "a.png").code == 0
    table = run("evaluate", made_scene, out, "--lpips", "none").out
    assert f"a{ending}" in table


@pytest.mark.parametrize("ending", [".spz", ".splat"])
def test_one_per_pixel_in_other_formats(ending: str, made_scene: Path, tmp_path: Path, run: Run) -> None:
    whole, out = tmp_path / f"whole{ending}", tmp_path / "out.ply"
    gsmerge.write_gaussians(whole, gsmerge.read_scene(made_scene).gaussians)
    places = ("--cameras", made_scene / "transforms.json", "--images", made_scene / "images")
    outcome = run("compact", whole, *places, "--fit", "none", *SMALL, "-o", out, "--json", code=0)
    assert json.loads(outcome.out)["output"]["num_gaussians"] > 10


def test_no_normals(encoded: Path, tmp_path: Path, run: Run) -> None:
    sizes = []
    for name, extra in {"a": (), "b": ("--set", "normals=false")}.items():
        assert run("decode", encoded, "-o", tmp_path / f"{name}.ply", *extra).code == 0
        sizes.append(gsmerge.read_ply(tmp_path / f"{name}.ply").info)
    assert sizes[0].bytes_by_attribute["normals"] == 12 * sizes[0].count
    assert "normals" not in sizes[1].bytes_by_attribute
    assert sizes[1].count == sizes[0].count
