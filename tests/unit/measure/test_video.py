"""Videos: what is written can be read back, whole, and without a word from the libraries below."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.measure import preview
from gsmerge.measure.preview import Picture


def frames(count: int, height: int = 48, width: int = 64) -> Iterator[Picture]:
    """A red bar on grey that grows from the left."""
    for i in range(count):
        picture = np.full((height, width, 3), 90, np.uint8)
        picture[:, : 4 * i + 4] = 220, 20, 20
        yield picture


def read(path: Path) -> list[np.ndarray]:
    reader, pictures = cv2.VideoCapture(str(path)), []
    while (step := reader.read())[0]:
        pictures.append(step[1][..., ::-1])
    return pictures


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "A.MP4"])
def test_a_video_is_what_was_drawn(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    encoding = preview.write_video(tmp_path / name, frames(12), 24)
    assert encoding in ("VP9", "VP8", "MPEG-4")
    shown = read(tmp_path / name)
    assert len(shown) == 12
    for drawn, picture in zip(frames(12), shown, strict=True):
        assert np.abs(drawn.astype(float) - picture).mean() < 12
    assert cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FPS) == 24
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert capfd.readouterr() == ("", "")


def test_odd_sides_get_one_more(tmp_path: Path) -> None:
    preview.write_video(tmp_path / "a.mp4", frames(3, 47, 63), 30)
    assert [picture.shape for picture in read(tmp_path / "a.mp4")] == [(48, 64, 3)] * 3


def test_another_encoder_stands_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(preview.ENCODERS, ".mp4", (("none", "None"), ("mp4v", "MPEG-4")))
    assert preview.write_video(tmp_path / "a.mp4", frames(3), 30) == "MPEG-4"
    assert len(read(tmp_path / "a.mp4")) == 3


def test_without_an_encoder_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(preview.ENCODERS, ".mp4", (("none", "VP9"), ("nope", "MPEG-4")))
    with refuses(SceneError, "a.mp4", "VP9", "MPEG-4"):
        preview.write_video(tmp_path / "a.mp4", frames(3), 30)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("before", [0, 2])
def test_a_folder_that_vanishes_is_not_blamed_on_opencv(before: int, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()

    def vanishing() -> Iterator[Picture]:
        for done, picture in enumerate(frames(4)):
            if done == before:
                shutil.rmtree(folder)
            yield picture

    with refuses(SceneError, "a.mp4", "No such file or directory"):
        preview.write_video(folder / "a.mp4", vanishing(), 24)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.mp4", "a.webm"])
def test_a_cut_video_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a full disk, about which the encoders say nothing: the last frames are not in the file."""
    whole = preview._check_frames

    def cut(path: Path, temporary: Path, count: int) -> None:
        temporary.write_bytes(temporary.read_bytes()[:-700])
        whole(path, temporary, count)

    monkeypatch.setattr(preview, "_check_frames", cut)
    with refuses(SceneError, name, 12):
        preview.write_video(tmp_path / name, frames(12), 24)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_while_drawing_leaves_the_old_file(tmp_path: Path) -> None:
    def broken() -> Iterator[Picture]:
        yield from frames(3)
        raise RuntimeError("drawing failed")

    old = tmp_path / "a.mp4"
    old.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="drawing failed"):
        preview.write_video(old, broken(), 30, overwrite=True)
    assert old.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_endings() -> None:
    assert [preview.is_video(Path(name)) for name in ("a.mp4", "a.WEBM", "a.png", "folder")] == [
        True,
        True,
        False,
        False,
    ]
