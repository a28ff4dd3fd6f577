"""The commands work on a scene that the project makes itself."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scene import edited_json

import gsmerge
from gsmerge.cli import main
from gsmerge.drawing.preview import GAP_PIXELS, LABEL_HEIGHT

from .conftest import Run, listing

VIEWS, HEIGHT, WIDTH = 5, 32, 48
SMALL = ("--set", "superpixels=200")
QUICK = (*SMALL, "--fit", "none", "--effort", "draft")  # where the result does not matter


def test_compact_prints_a_summary_of_the_file_it_writes_beside_the_input(smallest_copy: Path, run: Run) -> None:
    outcome = run("compact", smallest_copy / "scene.ply", "--k", 2, *SMALL, code=0)
    out = smallest_copy / "scene.compact.ply"
    count = len(gsmerge.read_ply(out).gaussians)
    assert 0 < count <= 3 * 200 * 2
    said = " ".join(outcome.out.split())
    assert f"Gaussians 1,152 {count:,} " in said
    assert re.search(r" dB .* time \d+\.\d s most in", said)  # the time of each stage is in the report


def test_json_report_describes_input_output_and_run(smallest_copy: Path, run: Run) -> None:
    out = smallest_copy / "small.ply"
    outcome = run("compact", smallest_copy, "-o", out, *SMALL, "--k", 1, "--seed", 3, "--json", code=0)
    assert outcome.err == ""
    document = json.loads(outcome.out)
    ply = smallest_copy / "scene.ply"
    assert document["schema_version"] == 2
    assert document["tool"] == {"name": "gsmerge", "version": gsmerge.__version__}
    assert document["input"]["sha256"] == hashlib.sha256(ply.read_bytes()).hexdigest()
    assert document["input"]["bytes"] == ply.stat().st_size
    assert document["input"]["num_gaussians"] == 3 * 24 * 16
    assert [document["input"][name] for name in ("num_views", "height", "width")] == [3, 16, 24]
    assert (document["input"]["opacity_encoding"], document["input"]["num_nonfinite"]) == ("logit", 0)
    assert document["output"]["bytes"] == out.stat().st_size
    assert document["output"]["num_gaussians"] == len(gsmerge.read_ply(out).gaussians)
    assert document["ratio"] == pytest.approx(document["output"]["num_gaussians"] / (3 * 24 * 16))
    assert (document["seed"], document["options"]["k"], document["options"]["superpixels"]) == (3, 1, 200)
    assert set(document["seconds"]) >= {"import", "read", "segment", "encode", "decode", "write"}
    assert document["total_seconds"] == pytest.approx(sum(document["seconds"].values()), abs=1e-2)
    assert document["psnr_input_views"]["after"] > 15
    assert document["peak_memory_bytes"] > 1e7


def test_verbose_and_the_report_say_why_files_are_used(smallest_copy: Path, run: Run) -> None:
    (smallest_copy / "sparse/0").mkdir(parents=True)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (smallest_copy / "sparse/0" / name).write_text("")
    words = ("compact", smallest_copy, "-o", smallest_copy / "small.ply", *QUICK, "--json", "--overwrite")
    outcome = run(*words, "-v", code=0)
    cameras, others, photos = outcome.err.splitlines()
    assert re.fullmatch(r"cameras +transforms.json +chosen +[\d.]+ % of the Gaussians lie near their pixels", cameras)
    assert re.match(r"cameras +sparse/0 +left out +not examined, since others fit", others)
    assert re.fullmatch(r"photos +images +chosen +show 3 of 3 views", photos)
    used = json.loads(outcome.out)["input"]["candidates"]
    assert [(one["kind"], one["path"]) for one in used] == [("cameras", "transforms.json"), ("photos", "images")]
    assert used[1]["reason"] == "show 3 of 3 views"
    assert run(*words, "-v", "-q", code=0).err == ""
    assert "transforms.json" in run(*words, "-v", "--dry-run", code=0).err
    (smallest_copy / "others").mkdir()
    for name in ("x.png", "y.png"):
        noise = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
        cv2.imwrite(str(smallest_copy / "others" / name), noise)
    err = run(*words, "-v", "--images", smallest_copy / "others", code=3).err
    shown, _, refusal = err.partition("\ngsmerge: error:")
    assert re.match(r"cameras +transforms.json +left out", shown)  # a refusal shows what was tried, too
    assert refusal


def test_a_scene_too_large_for_the_machine_is_noted_before_it_is_read(
    smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = "this machine has 0.1 GB"
    assert said not in run("inspect", smallest_copy).out
    monkeypatch.setattr("gsmerge.runtime.memory.machine_memory", lambda: 10**8)
    outcome = run("compact", smallest_copy, *QUICK, "--overwrite", code=0)
    assert [line for line in outcome.err.splitlines() if said in line] == outcome.err.splitlines()[:1]
    assert said in run("inspect", smallest_copy).out
    assert said in run("compact", smallest_copy, "--dry-run", "--overwrite", *SMALL).out
    quiet = run("compact", smallest_copy, *QUICK, "--overwrite", "--quiet")
    assert (quiet.out, quiet.err) == ("", "")


def test_progress_is_shown_in_terminals_alone(smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fast = (*QUICK, "--overwrite")
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    assert "segment" not in run("compact", smallest_copy, *fast).err
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "segment" in run("compact", smallest_copy, *fast).err
    assert run("compact", smallest_copy, *fast, "--quiet").err == ""
    assert run("compact", smallest_copy, *fast, "--json").err == ""


def test_dry_run_prints_matching_networks_and_counts(small_scene: Path, run: Run) -> None:
    message = run("compact", small_scene, "--dry-run", "--fit", "none").out
    assert "views: overlap" in message
    assert "networks: shipped" in message
    assert "views: none" in run("compact", small_scene, "--dry-run", "--effort", "draft").out
    assert "2,000 Gaussians" in run("compact", small_scene, "--dry-run", "--k", 2, *SMALL).out
    plan = json.loads(run("compact", small_scene, "--dry-run", "--json", *SMALL).out)["compact"]
    assert (plan["superpixels_per_view"], plan["seconds"] > 0, plan["memory_bytes"] > 1e8) == (200, True, True)


def test_inspect_describes_a_scene_with_the_plan_of_compact(small_scene: Path, run: Run) -> None:
    outcome = run("inspect", small_scene, code=0)
    assert "17-column" in outcome.out
    assert "7,680" in outcome.out
    assert f"{VIEWS} x {HEIGHT} x {WIDTH}" in outcome.out
    document = json.loads(run("inspect", small_scene, "--json").out)
    assert (document["count"], document["num_views"], document["width"]) == (7680, VIEWS, WIDTH)
    planned = json.loads(run("compact", small_scene, "--dry-run", "--json").out)
    assert document["compact"] == planned["compact"]


def test_render_draws_each_view_most_like_its_own_photo(made_scene: Path, tmp_path: Path, run: Run) -> None:
    cameras = made_scene / "transforms.json"
    run("render", made_scene / "scene.ply", "--cameras", cameras, "-o", tmp_path / "frames", code=0)
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == [f"view_{i:03d}.png" for i in range(VIEWS)]
    photos = [cv2.imread(str(made_scene / "images" / name)).astype(float) for name in names]
    for i, name in enumerate(names):
        render = cv2.imread(str(tmp_path / "frames" / name)).astype(float)
        errors = [np.abs(photo - render).mean() for photo in photos]
        assert int(np.argmin(errors)) == i
        assert errors[i] < 20  # of 255 levels


def test_render_of_two_scenes_shows_them_side_by_side(made_scene: Path, tmp_path: Path, run: Run) -> None:
    run(
        "render", made_scene, made_scene / "scene.ply", "-o", tmp_path / "some", "--views", 2, "--size", "64x64", code=0
    )
    assert list(listing(tmp_path / "some")) == ["view_001.png", "view_003.png"]  # of two scenes, side by side
    both = cv2.imread(str(tmp_path / "some" / "view_001.png"))
    assert both.shape[1] >= 2 * 320
    half = both.shape[1] // 2 - 2
    assert (both[22:, :half] == both[22:, half + 4 :]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("hint", "width"), [((), 1920), (("--hint", "max_side=1200"), 1200)])
def test_pictures_of_views_are_as_large_as_asked(
    hint: tuple[str, ...], width: int, small_copy: Path, tmp_path: Path, run: Run
) -> None:
    """The cameras' own size, unless a hint names one, its default too."""
    (small_copy / "images").rename(tmp_path / "images")  # whose size would count
    with edited_json(small_copy / "transforms.json") as document:
        for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            document[name] *= 40
    call = ("render", small_copy / "scene.ply", "-o", tmp_path / "out", "--hint", "order=none", *hint)
    document = json.loads(run(*call, "--views", 1, "--json", code=0).out)
    assert document["width"] == width == cv2.imread(document["pictures"][0]).shape[1]


def test_render_into_one_picture_shows_photo_before_and_after(small_copy: Path, run: Run) -> None:
    assert run("compact", small_copy, *QUICK, "--quiet").code == 0
    out = small_copy / "preview.png"
    run("render", small_copy / "scene.ply", small_copy / "scene.compact.ply", "-o", out, code=0)
    sheet = cv2.imread(str(out))
    assert sheet.shape[1] >= 3 * WIDTH  # photo, before, after
    assert sheet.shape[0] >= 5 * HEIGHT  # four views, and one from outside
    alone = small_copy / "alone.png"  # in the frame, and with the photos, of what it was compacted from
    assert run("render", small_copy / "scene.compact.ply", "-o", alone, "--views", 1).code == 0
    assert 2 * WIDTH <= cv2.imread(str(alone)).shape[1] < sheet.shape[1]


def test_a_panel_of_a_size_cuts_photos_as_it_cuts_views(small_copy: Path, run: Run) -> None:
    out, call = small_copy / "wide.jpg", ("render", small_copy, "--views", 1, "--size", "480x160")
    run(*call, "-o", out, code=0)
    assert out.read_bytes()[:2] == b"\xff\xd8"
    sheet = cv2.imread(str(out)).astype(float)
    assert sheet.shape == (2 * (160 + LABEL_HEIGHT) + GAP_PIXELS, 2 * 480 + GAP_PIXELS, 3)
    photo, view = (
        sheet[LABEL_HEIGHT : LABEL_HEIGHT + 160, :480],
        sheet[LABEL_HEIGHT : LABEL_HEIGHT + 160, 480 + GAP_PIXELS :],
    )
    whole = cv2.imread(str(small_copy / "images" / "view_002.png"))
    whole = cv2.resize(whole, (480, 320), interpolation=cv2.INTER_CUBIC)
    run(*call, "-o", small_copy / "views", code=0)
    alone = cv2.imread(str(small_copy / "views" / "view_002.png"))
    assert [np.abs(photo - whole[80:240]).mean() < 4, np.abs(view - alone).mean() < 4] == [True, True]


def test_version_option_prints_the_version(run: Run) -> None:
    assert run("--version").out == f"gsmerge {gsmerge.__version__}\n"


@pytest.mark.parametrize(("words", "offered"), [("gsmerge com", "compact"), ("gsmerge compact --overw", "--overwrite")])
def test_shell_completion_offers_commands_and_options(
    words: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_GSMERGE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code == 0
    assert capsys.readouterr().out.split() == [offered]


def test_json_progress_has_stages_as_lines_of_json(small_scene: Path, tmp_path: Path, run: Run) -> None:
    """Whatever is quiet; of levels, every fit counts."""
    call = ("compact", "--progress=json", small_scene, "-o", tmp_path / "a.ply", "--effort", "draft", "--levels", "2")
    outcome = run(*call, "--quiet", code=0)
    events = [json.loads(line) for line in outcome.err.splitlines()]
    assert [event["stage"] for event in events][-1] == "done"
    assert all(list(event) == list(events[0]) for event in events)
    assert any(event["stage"] == "fit" and event["seconds_left"] is not None for event in events)
    shares = [event["share"] or 0 for event in events]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    first = next(event for event in events if event["stage"] == "score")  # of the first of two results
    assert first["share"] < 0.95
    seconds = [event["seconds"] for event in events]
    assert seconds == sorted(seconds)


def test_json_progress_has_notes_and_errors_as_lines_of_json(small_scene: Path, tmp_path: Path, run: Run) -> None:
    """Each an object with its kind as a key; without the option they are lines of text."""
    bare = tmp_path / "bare.ply"
    bare.write_bytes((small_scene / "scene.ply").read_bytes())
    outcome = run("compact", bare, "--effort", "draft", "--progress", "json", code=0)
    events = [json.loads(line) for line in outcome.err.splitlines()]
    assert any("note" in event for event in events)
    assert all({"share", "seconds", "seconds_left"} < {*event} for event in events)
    assert [event["seconds"] for event in events] == sorted(event["seconds"] for event in events)
    for words, code in ((("compact", tmp_path / "none.ply"), 3), (("compact", bare, "--effort", "soon"), 2)):
        (line,) = run(*words, "--progress", "json", code=code).err.splitlines()
        assert str(words[1]) in json.loads(line)["error"] or code == 2
        assert run(*words, code=code).err.startswith("gsmerge: error: ")
