"""``render`` makes videos, GIFs and frames along a path, of one scene, or of several under lines that move."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bare_files import write_without_grid
from messages import ERROR, names, says
from sweeps import sweep
from tiny_scene import edited_json

import gsmerge

from .conftest import Run, listing

WIDTH, HEIGHT = 48, 32
SCALE = 1.8  # of the cameras' world to that of the Gaussians


def read(path: Path) -> list[np.ndarray]:
    reader, pictures = cv2.VideoCapture(str(path)), []
    while (step := reader.read())[0]:
        pictures.append(step[1].astype(float))
    return pictures


def error(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(float) - other).mean())


@sweep(("kind", "name"), [("orbit", "a.mp4"), ("orbit", "a.gif"), ("spline", "a.webm")])
def test_a_video_shows_the_frames_of_its_path(
    kind: str, name: str, small_scene: Path, tmp_path: Path, run: Run
) -> None:
    call = ("render", small_scene, "--path", kind, "--frames", 8)
    outcome = run(*call, "-o", tmp_path / name, code=0)
    seconds = "0.6 s" if name.endswith(".gif") else "0.3 s"
    assert says(outcome.out.splitlines()[-1], tmp_path / name, "8 frames", f"{WIDTH} x {HEIGHT}", seconds)
    run(*call, "-o", tmp_path / "frames", code=0)
    assert list(listing(tmp_path / "frames")) == [f"frame_{i:05d}.png" for i in range(8)]
    drawn = [cv2.imread(str(path)) for path in sorted((tmp_path / "frames").iterdir())]
    shown = read(tmp_path / name)
    assert [picture.shape for picture in shown] == [(HEIGHT, WIDTH, 3)] * 8
    assert max(error(a, b) for a, b in zip(drawn, shown, strict=True)) < 12
    assert min(error(a, b) for a, b in zip(drawn[1:], drawn, strict=False)) > 0


@pytest.mark.slow
def test_line_moves_between_two_scenes_of_a_clip(small_copy: Path, tmp_path: Path, run: Run) -> None:
    """Left of it is the first, right of it the second, each with its caption; it starts in the middle."""
    scene, dark = small_copy / "scene.ply", tmp_path / "dark.ply"
    gaussians = gsmerge.read_ply(scene).gaussians[::2]
    gsmerge.write_ply(dark, replace(gaussians, sh0=gaussians.sh0 * 0 - 3, shN=gaussians.shN * 0))
    call = ("render", scene, dark, "--path", "orbit", "--frames", 4, "--size", "320x240")
    document = json.loads(run(*call, "-o", tmp_path / "a.mp4", "--json", code=0).out)
    assert document["scenes"] == {str(scene): 7680, str(dark): 3840}
    assert (document["frames"], document["fps"], document["pictures"]) == (4, 30, [str(tmp_path / "a.mp4")])
    run(*call, "-o", tmp_path / "frames", code=0)
    run("render", scene, *call[3:], "-o", tmp_path / "alone", code=0)
    places = []
    for i, shown in enumerate(read(tmp_path / "a.mp4")):
        frame, alone = (cv2.imread(str(tmp_path / name / f"frame_{i:05d}.png")) for name in ("frames", "alone"))
        assert frame.shape == shown.shape == (240, 320, 3)
        assert error(frame, shown) < 12
        above = frame[:180].astype(float)  # the captions
        places.append(min(place for place in range(320) if (above[:, place] == 255).all()))
        assert (above[:, : places[-1] - 2] == alone[:180, : places[-1] - 2]).all()
        assert above[:, places[-1] + 6 :].max() < 30
    assert places[0] == pytest.approx(160, abs=2)
    assert places[1] == max(places) > 290
    assert places[3] == min(places) < 30
    captions = cv2.imread(str(tmp_path / "frames" / "frame_00000.png"))[190:]
    assert [int((half > 200).sum()) > 300 for half in (captions[:, :150], captions[:, 170:])] == [True, True]


def test_captions_of_files_of_one_name_have_their_folders(
    small_copy: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr("gsmerge.drawing.render_files.make_captions", lambda texts, *_: asked.append(texts) or [])
    monkeypatch.setattr("gsmerge.drawing.render_files.draw_swipe", lambda pictures, *_: pictures[0])
    scene, other = small_copy / "scene.ply", tmp_path / "other" / "scene.ply"
    other.parent.mkdir()
    shutil.copy(scene, other)
    run("render", scene, other, "--frames", 2, "-o", tmp_path / "a.gif", code=0)
    run("render", scene, other.rename(other.with_name("b.ply")), "--frames", 2, "-o", tmp_path / "b.gif", code=0)
    assert [[text[0] for text in texts] for texts in asked] == [
        [f"{small_copy.name}/scene.ply", "other/scene.ply"],
        ["scene.ply", "b.ply"],
    ]
    assert asked[0][0][1:] == ("7,680 Gaussians", f"{scene.stat().st_size / 1e3:.1f} kB")


def test_a_clip_is_an_orbit_by_default(small_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "a.gif"
    document = json.loads(run("render", small_scene, "-o", out, "--frames", 2, "--json", code=0).out)
    assert (document["path"], document["fps"], document["encoding"]) == ("orbit", 12.5, "GIF")
    assert out.read_bytes()[:6] == b"GIF89a"


@pytest.mark.slow
def test_only_pictures_with_photos_tell_what_photos_lack(small_copy: Path, tmp_path: Path, run: Run) -> None:
    next((small_copy / "images").iterdir()).unlink()
    for name, is_told in (("frames", False), ("panel.png", True)):
        words = ("--path", "orbit", "--frames", 2) if name == "frames" else ()
        said = run("render", small_copy, *words, "-o", tmp_path / name, code=0).err
        assert ("warning: photos of 1 of" in said) == is_told


def test_path_of_a_file_is_placed_as_held_out_views_are(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    """The cameras of the scene, and those of the path in their world, are in larger units than the Gaussians."""
    targets = tmp_path / "targets"
    shutil.move(scene_copy / "targets", targets)
    for path in (scene_copy / "transforms.json", targets / "transforms.json"):
        with edited_json(path) as data:
            for frame in data["frames"]:
                for row in frame["transform_matrix"][:3]:
                    row[3] *= SCALE
    run("render", scene_copy, "--path", targets, "-o", tmp_path / "out", code=0)
    photos = [cv2.imread(str(path)) for path in sorted((targets / "images").iterdir())]
    drawn = [cv2.imread(str(path)) for path in sorted((tmp_path / "out").iterdir())]
    assert len(drawn) == len(photos) > 2
    for i, picture in enumerate(drawn):
        errors = [error(picture, photo) for photo in photos]
        assert errors[i] == min(errors) < 20


@pytest.mark.slow
def test_a_scene_without_cameras_takes_those_of_the_path(small_copy: Path, tmp_path: Path, run: Run) -> None:
    bare = write_without_grid(small_copy / "scene.ply", tmp_path / "away" / "bare.ply")
    out = tmp_path / "out.mp4"
    run("render", bare, "--path", small_copy / "transforms.json", "-o", out, code=0)
    assert len(read(out)) == 5
    made = run("render", bare, "--path", "orbit", "--frames", 2, "-o", tmp_path / "x.mp4", code=0)
    assert "no cameras: " in made.err  # about the views that are placed
    assert len(read(tmp_path / "x.mp4")) == 2


@pytest.mark.slow
def test_clips_too_large_for_the_memory_are_refused(small_scene: Path, tmp_path: Path, run: Run) -> None:
    for name, more, parts in (
        ("a.mp4", ("--size", "4096x4096"), ("8,388,608", "4096 x 4096", "folder")),
        ("a.gif", ("--size", "1920x1080", "--frames", 100), ("134,217,728", "100 x 1920 x 1080", ".mp4")),
    ):
        outcome = run("render", small_scene, "-o", tmp_path / name, *more, code=3)
        assert says(outcome.err.removeprefix(ERROR), tmp_path / name, *parts)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("kind", "count"), [("spline,back:0.5", 12), ("orbit", 6)])
def test_frames_grow_with_the_views_of_a_spline(
    kind: str, count: int, smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.drawing.render_files.SECONDS", 0.2)
    outcome = run("render", smallest_scene, "--path", kind, "-o", tmp_path / kind[:5], "--json", code=0)
    assert json.loads(outcome.out)["frames"] == count


@sweep("kind", ["orbit", "spline"])
def test_a_small_world_is_drawn_as_a_large_one(kind: str, small_copy: Path, tmp_path: Path, run: Run) -> None:
    """Nothing near is cut off where a unit is large: what is nearest lies 2 % of one away here."""
    small = shutil.copytree(small_copy, tmp_path / "small")
    gaussians = gsmerge.read_ply(small / "scene.ply").gaussians
    shrunk = replace(gaussians, means=gaussians.means / 256, scales=gaussians.scales / 256)
    gsmerge.write_ply(small / "scene.ply", shrunk, overwrite=True)
    with edited_json(small / "transforms.json") as data:
        for frame in data["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] /= 256
    for scene in (small_copy, small):
        run("render", scene, "--path", kind, "--frames", 3, "-o", tmp_path / f"{scene.name} out", code=0)
    for path in sorted((tmp_path / "scene out").iterdir()):
        picture = cv2.imread(str(path))
        assert picture.std() > 10
        assert error(picture, cv2.imread(str(tmp_path / "small out" / path.name))) < 0.1


def test_a_picture_of_one_view_is_that_of_the_folder(small_scene: Path, tmp_path: Path, run: Run) -> None:
    """A view is named by its photo."""
    run("render", small_scene, "--background", "1", "-o", tmp_path / "all", code=0)
    for view, number in (("view_001", 1), ("view_002.png", 2)):
        more = ("--background", "1", "--views", view, "-o", tmp_path / "a.png", "--overwrite")
        run("render", small_scene, *more, code=0)
        assert (tmp_path / "a.png").read_bytes() == (tmp_path / f"all/view_{number:03d}.png").read_bytes()
    run("render", small_scene, small_scene / "scene.ply", "--views", "view_001", "-o", tmp_path / "panel.jpg", code=0)


def test_cameras_of_views_that_the_file_lacks_are_drawn(small_copy: Path, tmp_path: Path, run: Run) -> None:
    gaussians = gsmerge.read_ply(small_copy / "scene.ply").gaussians
    gsmerge.write_ply(small_copy / "scene.ply", gaussians[WIDTH * HEIGHT : 3 * WIDTH * HEIGHT], overwrite=True)
    run("render", small_copy, "-o", tmp_path / "all", code=0)
    assert list(listing(tmp_path / "all")) == [f"view_{i:03d}.png" for i in range(5)]


@pytest.mark.parametrize(("name", "size"), [("a.mp4", (50, 34)), ("a.gif", (49, 33))])
def test_videos_of_odd_sides_are_made_even_with_a_note(
    name: str, size: tuple[int, int], small_scene: Path, tmp_path: Path, run: Run
) -> None:
    call = ("render", small_scene, "--size", "49x33", "--frames", 2, "-o", tmp_path / name, "--json")
    document = json.loads(run(*call, code=0).out)
    assert read(tmp_path / name)[0].shape[1::-1] == size == (document["width"], document["height"])
    said = [note for note in document["notes"] if names(note, "49 x 33", "50 x 34", "even")]
    assert len(said) == (name == "a.mp4")


@pytest.mark.parametrize(
    ("flags", "name", "words"),
    [
        (("--views", "view_001"), "a.gif", ("--views", "number", "--path")), (("--views", "0"), "folder", ("--views",)),
        (("--views", "nine"), "a.png", ("--views nine", "view_000")),
        (("--background", "nothing"), "folder", ("--background", "or none")), (("--background", "2"), "folder", ()),
        (("--background", "nan"), "folder", ()),
    ],
)  # fmt: skip
def test_views_and_backgrounds_that_do_not_fit_are_refused(
    flags: tuple[str | int, ...], name: str, words: tuple[str, ...], small_scene: Path, tmp_path: Path, run: Run
) -> None:
    """Nothing that is asked for is left out without a word."""
    outcome = run("render", small_scene, *flags, "-o", tmp_path / name, code=2)
    assert all(word in outcome.err for word in words)
    assert not (tmp_path / name).exists()


def test_pictures_without_a_background_are_transparent(small_scene: Path, tmp_path: Path, run: Run) -> None:
    run("render", small_scene, "--background", "none", "-o", tmp_path / "all", code=0)
    run("render", small_scene, "-o", tmp_path / "black", code=0)
    for path in (tmp_path / "all").iterdir():
        clear = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(float)
        black = cv2.imread(str(tmp_path / "black" / path.name)).astype(float)
        assert clear.shape[-1] == 4
        assert np.abs(clear[..., :3] * clear[..., 3:] / 255 - black).max() <= 2
