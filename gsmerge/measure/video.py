"""Write frames as a video, with the encoders that come with OpenCV."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io import atomic_output
from gsmerge.measure.preview import Picture
from gsmerge.types import StrPath

# Encoders by the ending of a name, the first that OpenCV has is used, with their names. Browsers play all but the last
# of .mp4. VP8 takes a third of the time of VP9 and 1.6 times the space.
ENCODERS = {
    ".mp4": (("vp09", "VP9"), ("mp4v", "MPEG-4")),
    ".webm": (("VP80", "VP8"), ("VP90", "VP9")),
}
FOLDER = "name a folder instead, for one picture a frame, or install opencv-contrib-python-headless"


def is_video(path: Path) -> bool:
    """Return whether a name ends as a video does that can be written."""
    return path.suffix.lower() in ENCODERS


def write_video(path: StrPath, frames: Iterable[Picture], fps: int, *, overwrite: bool = False) -> str:
    """Write pictures ``[h,w,3]`` of one size as a video, and return the name of its encoding.

    One frame is in memory at a time. Odd sides get one more row or column, a copy of the last, since encodings have
    none. SceneError if OpenCV has no encoder for the name's ending, or the file cannot be written whole.
    """
    path = Path(path)
    with atomic_output(path, overwrite=overwrite) as temporary:
        even = map(_to_even, frames)
        first = next(even)
        writer, encoding = _open_writer(path, temporary, first, fps)
        count = 0
        try:
            for frame in chain([first], even):
                with _silent_stderr():
                    writer.write(frame[..., ::-1])
                count += 1
        finally:
            with _silent_stderr():
                writer.release()
        _check_frames(path, temporary, count)
    return encoding


def _to_even(picture: Picture) -> Picture:
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _open_writer(path: Path, temporary: Path, first: Picture, fps: int) -> tuple[cv2.VideoWriter, str]:
    """Open a file with the first encoder that there is; also return the name of its encoding."""
    height, width = first.shape[:2]
    encoders = ENCODERS[path.suffix.lower()]
    for code, name in encoders:
        with _silent_stderr():
            fourcc = cv2.VideoWriter.fourcc(*code)
            writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, fourcc, fps, (width, height))
        if writer.isOpened():
            return writer, name
    names = " and ".join(name for _, name in encoders)
    raise SceneError(path, f"this OpenCV cannot write it: it has none of the encoders {names}", FOLDER)


def _check_frames(path: Path, temporary: Path, count: int) -> None:
    """Raise a SceneError if a video has not all frames, since the encoders do not say when a disk is full."""
    with _silent_stderr():
        reader = cv2.VideoCapture(str(temporary), cv2.CAP_FFMPEG)
        readable = 0
        while reader.grab():
            readable += 1
        reader.release()
    if readable != count:
        problem = f"could not be written whole: {readable} of {count} frames can be read"
        raise SceneError(path, problem, "free some space, or write elsewhere")


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Keep the lines away that OpenCV and FFmpeg print about encoders, at the level of the process."""
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
