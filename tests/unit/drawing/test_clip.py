"""Videos can be read back as a whole, and the libraries below write no words."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest
from messages import refuses
from PIL import Image

from gsmerge.drawing import clip
from gsmerge.drawing.preview import BytePicture
from gsmerge.errors import SceneError
from gsmerge.io.image_names import is_clip


def draw_frames(count: int, height: int = 48, width: int = 64) -> Iterator[BytePicture]:
    """Draw a red bar on grey that grows from the left."""
    for i in range(count):
        picture = np.full((height, width, 3), 90, np.uint8)
        picture[:, : 4 * i + 4] = 220, 20, 20
        yield picture


def read_frames(path: Path) -> list[np.ndarray]:
    reader, pictures = cv2.VideoCapture(str(path)), []
    while (step := reader.read())[0]:
        pictures.append(step[1][..., ::-1])
    return pictures


FFMPEG = f"""#!{sys.executable}
import sys
if "-encoders" in sys.argv:
    print(" V....D libx264              H.264")
    sys.exit()
width, height = map(int, sys.argv[sys.argv.index("-s") + 1].split("x"))
import cv2, numpy as np
fps = int(sys.argv[sys.argv.index("-r") + 1])
frames = np.frombuffer(sys.stdin.buffer.read(), np.uint8).reshape(-1, height, width, 3)
writer = cv2.VideoWriter(sys.argv[-1], cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"vp09"), fps, (width, height))
for frame in frames:
    writer.write(np.ascontiguousarray(frame))
writer.release()
"""


@pytest.fixture(autouse=True)
def no_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide ffmpeg, so that all machines write the same."""
    monkeypatch.setenv("PATH", os.devnull)


@pytest.fixture
def ffmpeg(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a program that takes what ffmpeg takes on the PATH."""
    program = tmp_path_factory.mktemp("bin") / "ffmpeg"
    program.write_text(FFMPEG, encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))
    return program


@pytest.mark.skipif(os.name == "nt", reason="programs are no scripts there")
def test_videos_are_h264_where_ffmpeg_has_it(ffmpeg: Path, tmp_path: Path) -> None:
    assert clip.write_clip(tmp_path / "a.webm", draw_frames(2), 24) in ("VP8", "VP9")
    assert clip.write_clip(tmp_path / "a.mp4", draw_frames(12, 47, 63), 24) == "H.264"
    shown = read_frames(tmp_path / "a.mp4")
    assert len(shown) == 12
    for drawn, picture in zip(draw_frames(12, 48, 64), shown, strict=True):
        assert np.abs(drawn.astype(float) - picture).mean() < 12
    ffmpeg.write_text(FFMPEG.replace("libx264", "libx265"), encoding="utf-8")
    assert clip.write_clip(tmp_path / "b.mp4", draw_frames(2), 24) != "H.264"


@pytest.mark.skipif(os.name == "nt", reason="programs are no scripts there")
def test_an_ffmpeg_that_fails_leaves_no_file(ffmpeg: Path, tmp_path: Path) -> None:
    ffmpeg.write_text(FFMPEG.replace("width, height", "sys.exit(1)  # ", 1), encoding="utf-8")
    with refuses(SceneError, "a.mp4", 12):
        clip.write_clip(tmp_path / "a.mp4", draw_frames(12), 24)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "A.MP4"])
def test_a_video_shows_the_frames_that_were_drawn(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    encoding = clip.write_clip(tmp_path / name, draw_frames(12), 24)
    assert encoding in ("VP9", "VP8", "MPEG-4")
    shown = read_frames(tmp_path / name)
    assert len(shown) == 12
    for drawn, picture in zip(draw_frames(12), shown, strict=True):
        assert np.abs(drawn.astype(float) - picture).mean() < 12  # of 255: encoders lose that much
    assert cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FPS) == 24
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert is_clip(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_another_encoder_stands_in_for_a_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(clip.ENCODERS, ".mp4", (("none", "None"), ("mp4v", "MPEG-4")))
    assert clip.write_clip(tmp_path / "a.mp4", draw_frames(3), 30) == "MPEG-4"
    assert len(read_frames(tmp_path / "a.mp4")) == 3


def test_a_video_without_an_encoder_is_refused_without_a_file_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(clip.ENCODERS, ".mp4", (("none", "VP9"), ("nope", "MPEG-4")))
    with refuses(SceneError, "a.mp4", "VP9", "MPEG-4"):
        clip.write_clip(tmp_path / "a.mp4", draw_frames(3), 30)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("before", [0, 2])
def test_a_folder_that_vanishes_is_not_blamed_on_opencv(before: int, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()

    def vanishing() -> Iterator[BytePicture]:
        for done, picture in enumerate(draw_frames(4)):
            if done == before:
                shutil.rmtree(folder)
            yield picture

    with refuses(SceneError, "a.mp4", "No such file or directory"):
        clip.write_clip(folder / "a.mp4", vanishing(), 24)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.mp4", "a.webm"])
def test_a_cut_video_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a full disk, about which the encoders say nothing: the last frames are not in the file."""
    whole = clip._check_frames

    def cut(path: Path, temporary: Path, count: int) -> None:
        temporary.write_bytes(temporary.read_bytes()[:-700])
        whole(path, temporary, count)

    monkeypatch.setattr(clip, "_check_frames", cut)
    with refuses(SceneError, name, 12):
        clip.write_clip(tmp_path / name, draw_frames(12), 24)
    assert list(tmp_path.iterdir()) == []


def test_a_gif_repeats_its_frames_with_one_palette(tmp_path: Path) -> None:
    drawn = list(draw_frames(5))
    assert clip.write_clip(tmp_path / "a.gif", iter(drawn), 12.5) == "GIF"
    with Image.open(tmp_path / "a.gif") as gif:
        assert (gif.n_frames, gif.info["loop"], gif.info["duration"]) == (5, 0, 80)
        for i, frame in enumerate(drawn):
            gif.seek(i)
            assert (
                np.abs(np.asarray(gif.convert("RGB")).astype(float) - frame).mean() < 3
            )  # of 255: the palette has fewer colours
    header = (tmp_path / "a.gif").read_bytes()
    assert header[10] & 0x80  # a palette for all; a frame with one of its own has the same bit in its descriptor
    assert [block[8] & 0x80 for block in header.split(b"\x21\xf9\x04")[1:] if len(block) > 14 and block[5] == 0x2C] == [
        0
    ] * 5


def test_borders_between_scenes_swing_evenly_inside_the_frame() -> None:
    for count in (2, 3):
        places = np.array(clip.swipe_borders(count, 48, 8.0, 600))
        np.testing.assert_array_equal(places[0], np.arange(count + 1) * 600 // count)
        assert (np.diff(places, axis=1) > 0).all()
        assert places[:, 1].min() <= 60 // count < 300 < places[:, -2].max()
        steps = np.diff(np.vstack([places, places[:1]]), axis=0)
        assert np.abs(steps).max() < 60  # also from the last frame to the first
    assert clip.swipe_borders(1, 2, 8.0, 10) == [[0, 10], [0, 10]]


def test_captions_stay_in_their_scene_s_part() -> None:
    name = "a name that is longer than its part of the frame has room for.ply"
    texts = [(name, "1,182,720 Gaussians", "80.4 MB"), ("small.ply", "52,038 Gaussians", "3.5 MB")]
    tall = {}
    for width, height in ((480, 352), (1920, 1080), (256, 480), (64, 48)):
        left, right = clip.make_captions(texts, width, height)
        for caption, start, end in ((left, 0, width // 2), (right, width // 2, width)):
            box = caption.text.shape
            assert start <= caption.left < caption.left + box[1] <= end or width == 64
            assert caption.top >= 0
            tall[width] = box[0] / height
        frame = np.full((height, width, 3), 128, np.uint8)
        left.draw(frame)
        assert (frame == 245).any() or width == 64  # text
        assert (frame[: left.top] == 128).all()
    assert tall[480] == pytest.approx(tall[1920], abs=0.03)  # as large a part of a small frame
    assert tall[256] > tall[480]  # a line more, for there is less room


@pytest.mark.skipif(os.name == "nt", reason="an open file cannot be removed there")
def test_an_interruption_does_not_wait_for_the_encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which has frames to encode yet, for a file that is removed."""
    may_end, waited = Event(), list[bool]()

    class Writer:
        def write(self, _: BytePicture) -> None:
            pass

        def release(self) -> None:
            waited.append(may_end.wait(20))

    def interrupted() -> Iterator[BytePicture]:
        yield from draw_frames(3)
        raise KeyboardInterrupt

    monkeypatch.setattr(clip, "_open_writer", lambda *_: (Writer(), "VP9"))
    with pytest.raises(KeyboardInterrupt):
        clip.write_clip(tmp_path / "a.mp4", interrupted(), 24)
    assert (waited, list(tmp_path.iterdir())) == ([], [])
    may_end.set()


@pytest.mark.parametrize(("width", "last"), [(640, 3), (256, 4), (150, 1)])
def test_captions_have_whole_words(width: int, last: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three scenes side by side: numbers are never cut, and a name has its beginning and its end."""
    drawn = list[str]()
    monkeypatch.setattr(clip.cv2, "putText", lambda box, text, *_: drawn.append(text))
    clip.make_captions([("fox_of_the_best.ply", "1,187,654 Gaussians", "80.4 MB")] * 3, width, 480)
    name, *others = drawn[: len(drawn) // 3]
    assert name.startswith("f")
    assert name.endswith("y")
    assert len(others) == last - 1
    assert {word for text in others for word in text.split()} <= {"1,187,654", "Gaussians", "80.4", "MB"}
