"""Clips: scenes from the same cameras under a line that moves, with captions, as a video or a GIF."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gsmerge.errors import SceneError
from gsmerge.io import atomic_output
from gsmerge.kernels.elementary import sin
from gsmerge.measure.preview import FACE, Picture, shorten_text
from gsmerge.settings.pictures import GIF
from gsmerge.types import StrPath

# Encoders by the ending of a name, the first that OpenCV has is used, with their names. Browsers play all but the last
# of .mp4. VP8 takes a third of the time of VP9 and 1.6 times the space.
ENCODERS = {".mp4": (("vp09", "VP9"), ("mp4v", "MPEG-4")), ".webm": (("VP80", "VP8"), ("VP90", "VP9"))}
# How the program ffmpeg encodes frames with so many channels, and the encoder that it needs: nearly every program plays
# H.264, and browsers and editors read the alpha of VP9
BY_FFMPEG = {
    3: ("H.264", "libx264", "mp4", (
        "-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709",  # as players expect of large frames
        "-preset", "veryfast", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart",
    )),
    4: ("VP9 with alpha", "libvpx-vp9", "webm", (
        "-crf", "24", "-b:v", "0", "-pix_fmt", "yuva420p", "-deadline", "realtime", "-cpu-used", "6",
    )),
}  # fmt: skip
MAX_VIDEO_PIXELS = 1 << 23  # of a frame, a little more than 3840 x 2160: encoders take 150 bytes for each
MAX_GIF_PIXELS = 1 << 27  # of all frames: 400 MB of memory, and files that nobody sends
GIF_SAMPLE = 1 << 20  # pixels that the palette of a GIF is made of
OPENCV = "opencv-contrib-python-headless"
FOLDER = "name a folder instead, for one picture a frame"
SWIPE_SECONDS = 6  # in which the line goes to both sides and back
SWAY = 0.9  # of the way to the neighbouring lines, or the border
BLUE_FIRST = [2, 1, 0, 3]
LINE = 480  # by which the width of a frame is divided for that of the line


@dataclass(frozen=True, eq=False)
class Caption:
    """Text on a dark box in a frame."""

    left: int
    top: int
    text: np.ndarray  # [h,w,1] how much of a pixel is text, 0 to 1

    def draw(self, picture: Picture) -> None:
        """Draw the caption into a picture."""
        height, width = self.text.shape[:2]
        box = picture[self.top : self.top + height, self.left : self.left + width]
        text = self.text[: box.shape[0], : box.shape[1]]  # of a tiny frame
        box[:] = (0.35 * box * (1 - text) + 245 * text).round()


def make_captions(texts: Sequence[tuple[str, str, str]], width: int, height: int) -> list[Caption]:
    """Place the captions of scenes side by side at the bottom of a frame, from left to right.

    ``texts``: of each scene name, count and size, the latter two in one line where there is room.
    """
    scale, thickness = max(0.45, height / 900), max(1, round(height / 600))
    line = round(32 * scale)
    margin, most = line // 2, width // len(texts) - 2 * line

    def wide(text: str) -> int:
        return int(cv2.getTextSize(text, FACE, scale, thickness)[0][0])

    rows: list[tuple[str, ...]] = [(name, f"{count}, {size}") for name, count, size in texts]
    rows = rows if max(wide(row[1]) for row in rows) <= most else list(texts)
    scale *= min(1.0, max(0.6, 0.95 * most / max(wide(row[1]) for row in rows)))
    made = []
    for i, row in enumerate(rows):
        lines = [shorten_text(text, most, scale, thickness) for text in row]
        box = np.zeros((line * len(lines) + margin, max(map(wide, lines)) + 2 * margin), np.uint8)
        for number, text in enumerate(lines, 1):
            cv2.putText(box, text, (margin, number * line - margin // 4), FACE, scale, 255, thickness, cv2.LINE_AA)
        left = margin + (width - box.shape[1] - 2 * margin) * i // max(len(rows) - 1, 1)
        made.append(Caption(max(left, 0), max(height - margin - len(box), 0), box[..., None] / np.float32(255)))
    return made


def swipe_places(count: int, frames: int, fps: float, width: int) -> list[list[int]]:
    """Place the columns ``[frames,count+1]`` between which each of ``count`` scenes shows, 0 and ``width`` among them.

    They begin evenly spread, and move together to the right, to the left, and back.
    """
    rounds = max(1, round(frames / fps / SWIPE_SECONDS))
    sways = SWAY * sin(2 * np.pi * rounds * np.arange(frames) / frames)
    places = (np.arange(count + 1) + sways[:, None]) * width / count
    places[:, 0], places[:, -1] = 0, width
    return [list(map(int, row)) for row in places.round()]


def draw_swipe(pictures: Sequence[Picture], places: Sequence[int], captions: Sequence[Caption]) -> Picture:
    """Join the columns of scenes from the same camera in one frame, each with its caption, with lines between."""
    frame = np.empty_like(pictures[0])
    half = max(1, frame.shape[1] // (2 * LINE))
    for picture, caption, left, right in zip(pictures, captions, places[:-1], places[1:], strict=True):
        caption.draw(picture)
        frame[:, left:right] = picture[:, left:right]
    for place in places[1:-1]:
        frame[:, max(place - 2 * half, 0) : place + 2 * half] //= 2
        frame[:, max(place - half, 0) : place + half] = 255
    return frame


class FfmpegWriter:
    """Write frames of three or four channels with the program ffmpeg, by the calls of :class:`cv2.VideoWriter`."""

    def __init__(self, program: str, path: Path, shape: tuple[int, ...], fps: float) -> None:
        height, width, channels = shape
        order = {3: "bgr24", 4: "bgra"}[channels]
        frames = ("-f", "rawvideo", "-pix_fmt", order, "-s", f"{width}x{height}", "-r", str(fps), "-i", "-")
        _, encoder, container, encoding = BY_FFMPEG[channels]
        command = (program, "-v", "quiet", "-y", *frames, "-c:v", encoder, *encoding, "-f", container, str(path))
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)

    def write(self, frame: np.ndarray) -> None:
        """Add a frame ``[h,w,c]`` in the order blue, green, red, alpha."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended: the frames that are missing are counted later
            self.process.stdin.write(np.ascontiguousarray(frame).tobytes())

    def release(self) -> None:
        """Finish the file."""
        with suppress(BrokenPipeError):
            self.process.communicate()


def find_ffmpeg(encoder: str) -> str | None:
    """Find a program ffmpeg that has an encoder on the PATH; None if there is none."""
    program = shutil.which("ffmpeg")
    with suppress(OSError):
        if program is not None:
            listed = subprocess.run((program, "-hide_banner", "-encoders"), capture_output=True, check=False).stdout
            return program if f" {encoder} ".encode() in listed else None
    return None


def stored_size(path: StrPath, width: int, height: int) -> tuple[int, int]:
    """Return the size that frames have in a clip: colours of videos are kept for pairs of pixels, so sides are even."""
    odd = 0 if Path(path).suffix.lower() == GIF else 1
    return width + width % 2 * odd, height + height % 2 * odd


def write_clip(path: StrPath, frames: Iterable[Picture], fps: float, *, overwrite: bool = False) -> str:
    """Write pictures ``[h,w,3]`` of one size as a video or a GIF, and return the name of its encoding.

    Grey pictures ``[h,w]`` are taken, too. A ``.mp4`` is H.264 if :func:`find_ffmpeg` finds a program for it; otherwise
    the first encoding that OpenCV has is used. A ``.webm`` of pictures with alpha ``[h,w,4]`` needs that program. All
    frames of a GIF share a palette, and are in memory together.

    Of a video one frame is in memory at a time, and of :func:`stored_size`: odd sides get one more row or column, a
    copy of the last. SceneError if there is no encoder for the ending of the name, or the file cannot be
    written completely.
    """
    path = Path(path)
    with atomic_output(path, overwrite=overwrite) as temporary:
        if path.suffix.lower() == GIF:
            _write_gif(temporary, list(map(_to_channels, frames)), fps)
            return "GIF"
        even = (_to_even(_to_channels(frame)) for frame in frames)
        first = next(even)
        writer, encoding = _open_writer(path, temporary, first, fps)
        written: list[Future[None]] = []

        def encode(frame: Picture) -> None:
            writer.write(frame[..., BLUE_FIRST[: frame.shape[2]]])

        try:
            with ThreadPoolExecutor(1) as encoder:  # which takes one thread, while the next frame is drawn
                for frame in chain([first], even):
                    if written:
                        written[-1].result()
                    written.append(encoder.submit(encode, frame))
        finally:
            with _silent_stderr():
                writer.release()
        _check_frames(path, temporary, len(written))
    return encoding


def _write_gif(path: Path, frames: Sequence[Picture], fps: float) -> None:
    """Write a GIF that plays again and again, with the colours of a sample of all frames."""
    step = 1 + len(frames) * frames[0].shape[0] * frames[0].shape[1] // GIF_SAMPLE
    sample = np.concatenate([frame.reshape(-1, 3)[i % step :: step] for i, frame in enumerate(frames)])
    palette = Image.fromarray(sample[None]).quantize(256, Image.Quantize.FASTOCTREE)
    # Without dithering, which flickers, costs 1.6 dB and a quarter more bytes
    plain = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first, *others = plain
    first.save(path, "GIF", save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def _to_channels(picture: Picture) -> Picture:
    return picture if picture.ndim == 3 else picture[..., None].repeat(3, 2)


def _to_even(picture: Picture) -> Picture:
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _open_writer(path: Path, temporary: Path, first: Picture, fps: float) -> tuple[cv2.VideoWriter | FfmpegWriter, str]:
    """Open a file with the first available encoder; also return the name of its encoding."""
    height, width, channels = first.shape
    name, encoder, container, _ = BY_FFMPEG[channels]
    if path.suffix.lower() == f".{container}" and (program := find_ffmpeg(encoder)):
        return FfmpegWriter(program, temporary, first.shape, fps), name
    if channels > 3:
        problem = f"pictures with alpha need the program ffmpeg with {encoder} on the PATH, and none was found"
        raise SceneError(path, problem, FOLDER)
    encoders = ENCODERS[path.suffix.lower()]
    for code, name in encoders:
        with _silent_stderr():
            fourcc = cv2.VideoWriter.fourcc(*code)
            writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, fourcc, fps, (width, height))
        if writer.isOpened():
            return writer, name
    os.stat(str(temporary))  # fails, and says why, where the folder has vanished meanwhile
    names = " and ".join(name for _, name in encoders)
    raise SceneError(
        path, f"this OpenCV cannot write it: it has none of the encoders {names}", f"{FOLDER}, or install {OPENCV}"
    )


def _check_frames(path: Path, temporary: Path, count: int) -> None:
    """Raise a SceneError if frames of a video are missing, since encoders do not report a full disk."""
    with _silent_stderr():
        reader = cv2.VideoCapture(str(temporary), cv2.CAP_FFMPEG)
        readable = 0
        while reader.grab():
            readable += 1
        reader.release()
    if readable != count:
        os.stat(str(temporary))  # as in _open_writer
        problem = f"could not be written whole: {readable} of {count} frames can be read"
        raise SceneError(path, problem, "free some space, or write elsewhere")


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Suppress what OpenCV and FFmpeg print about encoders, at the level of the process."""
    try:
        kept = os.dup(2)
    except OSError:  # closed: there is nothing to keep away
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        with suppress(OSError, ValueError, AttributeError):
            sys.stderr.flush()
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(sink)
        os.close(kept)
