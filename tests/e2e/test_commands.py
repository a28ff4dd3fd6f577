"""The commands on a scene that the project makes itself."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from bare_files import write_without_grid
from tiny_scene import edited_json

import gsmerge
from gsmerge.cli import main
from gsmerge.measure.preview import BAND, GAP

from .conftest import Run, listing

VIEWS, HEIGHT, WIDTH = 5, 64, 96
SMALL = ("--set", "superpixels=200")
QUICK = (*SMALL, "--fit", "none", "--effort", "draft")  # where the result does not matter


def test_compact_writes_beside_the_input_and_says_what_it_did(small_copy: Path, run: Run) -> None:
    outcome = run("compact", small_copy / "scene.ply", "--k", 2, *SMALL, code=0)
    out = small_copy / "scene.compact.ply"
    count = len(gsmerge.read_ply(out).gaussians)
    assert 0 < count <= VIEWS * 200 * 2
    line = outcome.out
    assert line.count("\n") == 1
    assert f"7,680 -> {count:,} Gaussians" in line
    assert "dB" in line
    assert all(stage in line for stage in ("read", "segment", "encode", "fit", "write"))


def test_compact_of_a_folder_does_not_take_its_own_output_for_the_input(small_copy: Path, run: Run) -> None:
    assert run("compact", small_copy, *QUICK, "--quiet").code == 0
    assert run("compact", small_copy, *QUICK, "--quiet", "--overwrite").code == 0


def test_json_report(scene_copy: Path, run: Run) -> None:
    out = scene_copy / "small.ply"
    outcome = run("compact", scene_copy, "-o", out, *SMALL, "--k", 2, "--seed", 3, "--json", code=0)
    assert outcome.err == ""
    document = json.loads(outcome.out)
    ply = scene_copy / "scene.ply"
    assert document["schema_version"] == 1
    assert document["tool"] == {"name": "gsmerge", "version": gsmerge.__version__}
    assert document["input"]["sha256"] == hashlib.sha256(ply.read_bytes()).hexdigest()
    assert document["input"]["bytes"] == ply.stat().st_size
    assert document["input"]["num_gaussians"] == VIEWS * HEIGHT * WIDTH
    assert [document["input"][name] for name in ("num_views", "height", "width")] == [VIEWS, HEIGHT, WIDTH]
    assert (document["input"]["opacity_encoding"], document["input"]["num_nonfinite"]) == ("logit", 0)
    assert document["output"]["bytes"] == out.stat().st_size
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians)
    assert document["ratio"] == pytest.approx(document["output"]["num_gaussians"] / (VIEWS * HEIGHT * WIDTH))
    assert (document["seed"], document["options"]["k"], document["options"]["superpixels"]) == (3, 2, 200)
    assert set(document["seconds"]) >= {"import", "read", "segment", "encode", "decode", "write"}
    assert document["total_seconds"] == pytest.approx(sum(document["seconds"].values()), abs=1e-2)
    assert document["psnr_input_views"]["after"] > 15
    assert document["peak_memory_bytes"] > 1e7


def test_a_scene_too_large_for_the_machine_is_noted_before_it_is_read(
    small_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = "0.1 GB:"
    assert said not in run("inspect", small_copy).out
    monkeypatch.setattr("gsmerge.runtime.estimate.machine_memory", lambda: 10**8)
    outcome = run("compact", small_copy, *QUICK, "--overwrite", code=0)
    assert [line for line in outcome.err.splitlines() if said in line] == outcome.err.splitlines()[:1]
    assert said in run("inspect", small_copy).out
    assert said in run("compact", small_copy, "--dry-run", "--overwrite", *SMALL).out
    quiet = run("compact", small_copy, *QUICK, "--overwrite", "--quiet")
    assert (quiet.out, quiet.err) == ("", "")


def test_progress_only_when_a_terminal_is_there(small_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fast = (*QUICK, "--overwrite")
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    assert "segment" not in run("compact", small_copy, *fast).err
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "segment" in run("compact", small_copy, *fast).err
    assert run("compact", small_copy, *fast, "--quiet").err == ""
    assert run("compact", small_copy, *fast, "--json").err == ""


def test_a_plan_tells_what_is_used(made_scene: Path, run: Run) -> None:
    message = run("compact", made_scene, "--dry-run", "--fit", "none").out
    assert "views: overlap" in message
    assert "networks: shipped" in message
    assert "views: none" in run("compact", made_scene, "--dry-run", "--effort", "draft").out
    assert "2,000 Gaussians" in run("compact", made_scene, "--dry-run", "--k", 2, *SMALL).out
    plan = json.loads(run("compact", made_scene, "--dry-run", "--json", *SMALL).out)["compact"]
    assert (plan["superpixels_per_view"], plan["seconds"] > 0, plan["memory_bytes"] > 1e8) == (200, True, True)


def test_inspect(made_scene: Path, run: Run) -> None:
    outcome = run("inspect", made_scene, code=0)
    assert "17-column" in outcome.out
    assert "30,720" in outcome.out
    assert f"{VIEWS} x {HEIGHT} x {WIDTH}" in outcome.out
    document = json.loads(run("inspect", made_scene, "--json").out)
    assert (document["count"], document["num_views"], document["width"]) == (30720, VIEWS, WIDTH)
    assert document["opacity_encoding"] == "logit"
    assert document["alignment"]["ok"] is True
    assert document["alignment"]["share_within_1px"] > 0.9
    assert [view["share_of_pixels"] for view in document["coverage"]] == [1.0] * VIEWS
    planned = json.loads(run("compact", made_scene, "--dry-run", "--json").out)
    assert document["compact"] == planned["compact"]


def test_inspect_of_an_unaligned_file_is_no_error(compacted_scene: Path, run: Run) -> None:
    assert "pixel" in run("inspect", compacted_scene / "small.ply", code=0).out


def test_views(made_scene: Path, tmp_path: Path, run: Run) -> None:
    cameras = made_scene / "transforms.json"
    run("render", made_scene / "scene.ply", "--cameras", cameras, "-o", tmp_path / "frames", code=0)
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == [f"view_{i:03d}.png" for i in range(VIEWS)]
    photos = [cv2.imread(str(made_scene / "images" / name)).astype(float) for name in names]
    for i, name in enumerate(names):
        render = cv2.imread(str(tmp_path / "frames" / name)).astype(float)
        errors = [np.abs(photo - render).mean() for photo in photos]
        assert int(np.argmin(errors)) == i
        assert errors[i] < 20
    more = ("--views", 2, "--size", "64x64")
    run("render", made_scene, made_scene / "scene.ply", "-o", tmp_path / "some", *more, code=0)
    assert list(listing(tmp_path / "some")) == ["view_001.png", "view_003.png"]  # of two scenes, side by side
    both = cv2.imread(str(tmp_path / "some" / "view_001.png"))
    assert both.shape[1] >= 2 * 320
    half = both.shape[1] // 2 - 2
    assert (both[22:, :half] == both[22:, half + 4 :]).all()


@pytest.mark.parametrize(("hint", "width"), [((), 1920), (("--hint", "max_side=1200"), 1200)])
def test_pictures_of_views_are_as_large_as_asked(
    hint: tuple[str, ...], width: int, scene_copy: Path, tmp_path: Path, run: Run
) -> None:
    """The cameras' own size, unless a hint names one, its default too."""
    (scene_copy / "images").rename(tmp_path / "images")  # whose size would count
    with edited_json(scene_copy / "transforms.json") as document:
        for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            document[name] *= 20
    call = ("render", scene_copy / "scene.ply", "-o", tmp_path / "out", "--hint", "order=none", *hint)
    document = json.loads(run(*call, "--views", 1, "--json", code=0).out)
    assert document["width"] == width == cv2.imread(document["pictures"][0]).shape[1]


def test_panel(scene_copy: Path, run: Run) -> None:
    assert run("compact", scene_copy, *QUICK, "--quiet").code == 0
    out = scene_copy / "preview.png"
    run("render", scene_copy / "scene.ply", scene_copy / "scene.compact.ply", "-o", out, code=0)
    sheet = cv2.imread(str(out))
    assert sheet.shape[1] >= 3 * WIDTH  # photo, before, after
    assert sheet.shape[0] >= 5 * HEIGHT  # four views, and one from outside
    alone = scene_copy / "alone.png"  # in the frame, and with the photos, of what it was compacted from
    assert run("render", scene_copy / "scene.compact.ply", "-o", alone, "--views", 1).code == 0
    assert 2 * WIDTH <= cv2.imread(str(alone)).shape[1] < sheet.shape[1]


def test_a_panel_beside_the_scene_is_replaced_and_photos_are_not(small_copy: Path, run: Run) -> None:
    call = ("render", small_copy, "--views", 1, "--overwrite")
    for _ in range(2):
        run(*call, "-o", small_copy / "p.png", code=0)
    run(*call, "-o", small_copy / "images" / "view_000.png", code=2)
    run(*call, "--images", small_copy, "-o", small_copy / "p.png", code=2)


def test_a_panel_of_a_size_cuts_photos_as_it_cuts_views(scene_copy: Path, run: Run) -> None:
    out, call = scene_copy / "wide.jpg", ("render", scene_copy, "--views", 1, "--size", "480x160")
    run(*call, "-o", out, code=0)
    assert out.read_bytes()[:2] == b"\xff\xd8"
    sheet = cv2.imread(str(out)).astype(float)
    assert sheet.shape == (2 * (160 + BAND) + GAP, 2 * 480 + GAP, 3)
    photo, view = sheet[BAND : BAND + 160, :480], sheet[BAND : BAND + 160, 480 + GAP :]
    whole = cv2.imread(str(scene_copy / "images" / "view_002.png"))
    whole = cv2.resize(whole, (480, 320), interpolation=cv2.INTER_CUBIC)
    run(*call, "-o", scene_copy / "views", code=0)
    alone = cv2.imread(str(scene_copy / "views" / "view_002.png"))
    assert [np.abs(photo - whole[80:240]).mean() < 4, np.abs(view - alone).mean() < 4] == [True, True]


def test_a_view_of_one_scene(small_copy: Path, run: Run) -> None:
    """Of a folder, of a compact scene beside its cameras, and of a file that has none."""
    outcome = run("view", small_copy, "--no-open", code=0)
    page = small_copy / "scene.view.html"
    assert outcome.out.startswith(f"{page}: 7,680 Gaussians, ")
    assert "note" not in outcome.err
    run("compact", small_copy, *QUICK, "--quiet", code=0)
    run("view", small_copy / "scene.compact.ply", "--no-open", code=0)
    assert f"<title>{small_copy.name}</title>" in (small_copy / "scene.compact.view.html").read_text()
    bare = small_copy / "away" / "bare.ply"
    bare.parent.mkdir()
    (small_copy / "scene.ply").rename(bare)
    outcome = run("view", bare, "--no-open", code=0)
    assert "estimated" in outcome.err
    write_without_grid(bare, bare)
    outcome = run("view", bare, "--no-open", code=0)
    assert "cameras: " in outcome.err
    assert outcome.out.endswith("bare.view.html: 7,679 Gaussians\n")
    shutil.copy(bare, bare.with_name("x.ply"))
    outcome = run("view", bare, bare.with_name("x.ply"), "--no-open", code=0)
    assert "no cameras: " in outcome.err


def test_version(run: Run) -> None:
    assert run("--version").out == f"gsmerge {gsmerge.__version__}\n"


@pytest.mark.parametrize(("words", "offered"), [("gsmerge com", "compact"), ("gsmerge compact --overw", "--overwrite")])
def test_shell_completion(
    words: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_GSMERGE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code == 0
    assert capsys.readouterr().out.split() == [offered]
