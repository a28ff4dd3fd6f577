"""``--protect`` spends Gaussians and steps where its pictures are white."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import write_scene

import gsmerge
from e2e.conftest import Run
from gsmerge.method.raster.metrics import psnr

SIGN = slice(20, 34), slice(30, 52)  # of 64 x 96 pixels: 5 %


@pytest.mark.slow
def test_a_protected_part_of_the_photos_is_shown_better(run: Run, tmp_path: Path) -> None:
    room = write_scene(tmp_path / "room", num_views=3, width=96, height=64, seed=0)
    scene, after = gsmerge.read_scene(room), []
    picture = np.zeros((scene.cameras.height, scene.cameras.width), np.uint8)
    picture[SIGN] = 255
    for name in scene.names:
        path = (tmp_path / "signs" / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), picture)
    for words in ([], ["--protect", tmp_path / "signs"]):
        out = tmp_path / "small.ply"
        errors = []
        for seed in (0, 1):  # between which results of so few pixels differ by some tenths of a dB
            call = (
                "compact",
                room,
                "-o",
                out,
                "--budget",
                "2%",
                "--set",
                "fill=true",
                "--json",
                "--overwrite",
                "--seed",
                seed,
                *words,
            )
            done = run(*call)
            drawn = gsmerge.render(gsmerge.read_gaussians(out).gaussians, scene.cameras).images
            errors += [psnr(drawn[view].clip(0, 1)[SIGN], scene.images[view][SIGN]) for view in range(len(scene))]
        after.append((np.mean(errors), json.loads(done.out)))
    (plain, without), (better, report) = after
    assert without["psnr_protected"] is None
    assert report["output"]["num_gaussians"] == without["output"]["num_gaussians"]
    assert better > plain + 1
    protected = report["psnr_protected"]
    assert 0.03 < protected["share"] < 0.07
    assert protected["after"] > protected["before"]
    assert any(note.startswith("protect: ") for note in report["notes"])


@pytest.mark.slow
def test_a_batch_takes_no_masks_of_other_scenes(run: Run, tmp_path: Path) -> None:
    """A scene called masks and a folder of grey masks beside it change no bytes; the folder is named."""
    quick = ("--effort", "draft", "--set", "fit=none")
    for number, name in enumerate(("rooms/room", "rooms/masks", "halls/room")):
        room = write_scene(tmp_path / name, num_views=3, width=24, height=16, seed=number)
    for photo in (room / "images").iterdir():
        (path := tmp_path / "halls/masks" / photo.name).parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), np.tile(np.uint8([0, 255]), (16, 12)))
    for folder in ("rooms", "halls"):
        run("compact", tmp_path / folder / "room", "-o", alone := tmp_path / f"{folder}.ply", *quick, "--masks", "none")
        done = run("batch", tmp_path / folder, "-o", out := tmp_path / f"{folder}-small", *quick, "--strict", "--json")
        assert (out / "room.ply").read_bytes() == alone.read_bytes()
        assert (f"--masks {tmp_path}/halls/masks" in done.out) == (folder == "halls")


def test_batch_takes_masks_and_protected_parts_of_each_scene(run: Run, tmp_path: Path) -> None:
    """Masks and what is to be protected, as of ``compact``: the same bytes."""
    for number in (0, 1):
        room = write_scene(tmp_path / "rooms" / f"room{number}", num_views=3, width=24, height=16, seed=number)
        for name, level in (("shades", 255), ("signs", 0)):
            picture = np.full((16, 24), level, np.uint8)
            picture[:8, :12] = 255 - level
            for photo in (room / "images").iterdir():
                (room / name).mkdir(exist_ok=True)
                assert cv2.imwrite(str(room / name / f"{photo.stem}.png"), picture)
    quick, places = ("--effort", "draft", "--set", "fit=none"), ("--masks", "{parent}/shades", "--protect")
    batch = ("batch", tmp_path / "rooms", "-o", tmp_path / "out", *quick)
    lines = run(*batch, *places, "{parent}/signs", "--json", code=0).out.splitlines()
    reports = [json.loads(line)["report"] for line in lines]
    assert [report["psnr_protected"]["share"] > 0 for report in reports] == [True, True]
    assert all(any(note.startswith("masks leave out 25 %") for note in report["notes"]) for report in reports)
    own = ("--masks", room / "shades", "--protect", room / "signs")
    run("compact", room, "-o", tmp_path / "own.ply", *quick, *own, code=0)
    assert (tmp_path / "own.ply").read_bytes() == (tmp_path / "out" / "room1.ply").read_bytes()
    assert "'{parent}/signs'" in run(*batch, "--protect", "signs", code=3).err
