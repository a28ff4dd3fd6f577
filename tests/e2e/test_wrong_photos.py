"""Folders of photos of which some, or all, do not show the scene: what the result is worth on views not used."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from .conftest import Run

SETTINGS = ("--superpixels", 256, "--set", "fit_steps=60")
SLACK = 1.5  # dB that one or two photos of five less may cost; a swapped pair that passes costs 6.7


def blacken(photos: Sequence[Path]) -> None:
    for photo in photos:
        cv2.imwrite(str(photo), np.zeros_like(cv2.imread(str(photo))))


def scramble(photos: Sequence[Path]) -> None:
    rng = np.random.default_rng(0)
    for photo in photos:
        shape = cv2.imread(str(photo)).shape
        cv2.imwrite(str(photo), rng.integers(0, 256, shape).astype(np.uint8))


def swap(photos: Sequence[Path]) -> None:
    one, other = (photos[place].read_bytes() for place in (1, 3))
    photos[1].write_bytes(other)
    photos[3].write_bytes(one)


Psnr = Callable[[Path, Path], float]


@pytest.fixture
def photos(scene_copy: Path) -> list[Path]:
    return sorted((scene_copy / "images").iterdir())


@pytest.mark.parametrize("spoil", [blacken, scramble])
def test_wrong_photos_are_worth_no_less_than_the_input(
    scene_copy: Path, photos: list[Path], run: Run, target_psnr: Psnr, spoil: Callable[[Sequence[Path]], None]
) -> None:
    spoil(photos)
    out, report = scene_copy / "small.ply", scene_copy / "small.json"
    outcome = run("compact", scene_copy / "scene.ply", "-o", out, "--report", report, *SETTINGS, code=0)
    note = "5 of 5 photos do not show what the Gaussians show, so none is used and nothing is fitted"
    assert note in outcome.err + outcome.out
    assert "fit" not in json.loads(report.read_text())["choices"]
    targets = scene_copy / "targets"
    assert target_psnr(targets, out) > target_psnr(targets, scene_copy / "scene.ply")


@pytest.mark.parametrize(
    ("spoil", "wrong"), [(swap, [1, 3]), (lambda photos: blacken(photos[2:3]), [2])], ids=["swapped", "black"]
)
def test_a_few_wrong_photos_cost_little(
    scene_copy: Path,
    photos: list[Path],
    run: Run,
    target_psnr: Psnr,
    spoil: Callable[[Sequence[Path]], None],
    wrong: list[int],
) -> None:
    out, report, scores = scene_copy / "small.ply", scene_copy / "small.json", []
    for change in (None, spoil):
        if change is not None:
            change(photos)
        arguments = ("compact", scene_copy / "scene.ply", "-o", out, "--report", report, "--overwrite", *SETTINGS)
        assert run(*arguments).code == 0
        scores.append(target_psnr(scene_copy / "targets", out))
        names = [photos[place].name for place in wrong] if change is not None else []
        left_out = json.loads(report.read_text())["choices"].get("photos_left_out", [])
        assert [Path(name).name for name in left_out] == names
    assert scores[1] > scores[0] - SLACK
