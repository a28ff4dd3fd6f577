"""Files of SHARP are read as it leaves them: one with its photo, and several of one place as one scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from messages import noted
from shared import write_scene
from sharp_files import split_views, write_sharp

from gsmerge import read_cameras, read_scene
from gsmerge.runtime.threads import use_threads

from .conftest import Run, assert_refused

NAMES = ("IMG_0001", "IMG_0002")
WIDTH, SIDE = 96, 72
FIT = ("--set", "fit_steps=30", "--budget", "700", "--threads", 1)


@pytest.fixture(scope="module")
def sharp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return ``out/`` with two files, ``photos/`` that they were made of, and a file of another place. Read only."""
    folder = tmp_path_factory.mktemp("sharp")
    for name in ("out", "photos", "other"):
        (folder / name).mkdir()
    made = write_scene(folder / "made", num_views=4, width=WIDTH, height=SIDE, seed=2)
    parts = split_views(read_scene(made), (1.1, 0.85, 1.0, 1.0))
    for name, view in zip(NAMES, parts, strict=False):
        write_sharp(folder / "out" / f"{name}.ply", view, (2 * WIDTH, 2 * SIDE), folder / "photos" / f"{name}.jpg")
    other = write_scene(folder / "elsewhere", num_views=2, width=WIDTH, height=SIDE, seed=5)
    view = split_views(read_scene(other), (1.0, 1.0))[0]
    write_sharp(folder / "other" / "IMG_0009.ply", view, (2 * WIDTH, 2 * SIDE), folder / "photos" / "IMG_0009.jpg")
    return folder


@pytest.mark.slow
def test_several_files_become_one_scene(run: Run, sharp: Path, tmp_path: Path) -> None:
    """Three photos are matched and joined, and the result is fitted, which takes two seconds."""
    out, photos = tmp_path / "place.ply", sharp / "photos"
    files = [*(sharp / "out" / f"{name}.ply" for name in NAMES), sharp / "other/IMG_0009.ply"]
    report = json.loads(run("compact", *files, "--images", photos, "-o", out, *FIT, "--json", code=0).out)
    joined = report["input"]["files"]
    assert [Path(file["path"]).name for file in joined] == [file.name for file in files]
    assert [file["joined"] for file in joined] == [True, True, False]
    assert joined[0]["scale"] == 1
    assert abs(joined[1]["scale"] * 0.85 / 1.1 - 1) < 0.02
    assert report["input"]["num_gaussians"] == 2 * 2 * SIDE * SIDE
    assert report["input"]["bytes"] == sum(file.stat().st_size for file in files[:2])
    assert noted(report["notes"], "2 of 3", "joined", "IMG_0001.ply")
    assert noted(report["notes"], "IMG_0009.ply", "left")
    assert report["psnr_input_views"]["after"] > report["psnr_input_views"]["before"] + 2
    scores = json.loads(run("evaluate", out, "--images", photos, "--json", "--lpips", "none", code=0).out)
    assert scores["num_views"] == {"context": 2}
    # the frame is that of the first file, which the result is compared with as any other; by any number of threads
    one = read_scene(files[0], images=photos)
    with use_threads(3):
        both = read_scene(*files, images=photos)
    assert (both.cameras.viewmats[:1] == one.cameras.viewmats).all()
    written = read_cameras(tmp_path / "place.cameras.json").viewmats
    np.testing.assert_allclose(written, both.cameras.viewmats, atol=1e-12)


@pytest.mark.slow
def test_dry_run_counts_all_files(run: Run, sharp: Path) -> None:
    files = [sharp / "out" / f"{name}.ply" for name in NAMES]
    plan = json.loads(run("compact", *files, "--images", sharp / "photos", "--dry-run", "--json", code=0).out)
    assert plan["input"]["num_gaussians"] == 2 * 2 * SIDE * SIDE


def test_files_that_cannot_be_joined_are_refused(run: Run, sharp: Path, tmp_path: Path) -> None:
    first, second = (sharp / "out" / f"{name}.ply" for name in NAMES)
    stranger, out = sharp / "other/IMG_0009.ply", tmp_path / "a.ply"
    photos = ("--images", sharp / "photos")
    refused = run("compact", first, stranger, *photos, "-o", out, "-q")
    assert_refused(refused, 3, first, "two of 2", "--images")
    assert_refused(run("compact", first, tmp_path / "small.ply"), 3, "small.ply", "-o")
    assert_refused(run("compact", first, second, first, "-o", out), 2, first, "twice")
    assert_refused(run("compact", first, second, "--cameras", sharp / "made"), 2, "--cameras", "one scene")
    assert_refused(run("compact", first, second, "-o", second, "--overwrite"), 2, second, "input")
    assert not out.exists()
