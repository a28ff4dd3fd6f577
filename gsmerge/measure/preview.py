"""Pictures and videos for people: scenes from the same cameras side by side, superpixels drawn over photos."""

from __future__ import annotations

import base64
import html
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.errors import SceneError
from gsmerge.facts.views import pick_views
from gsmerge.io import atomic_output
from gsmerge.measure.camera_path import outside_camera
from gsmerge.raster import render
from gsmerge.raster.metrics import psnr
from gsmerge.types import Cameras, Gaussians, StrPath

Picture = NDArray[np.uint8]  # [h,w,3], sRGB, RGB order
BAND = 22  # height of the band that carries a tile's label, pixels
GAP = 4
OUTSIDE = "step back"  # name of the view from outside
BORDER_COLOR = (255, 230, 40)  # of superpixels: seldom in photos
# Encoders by the ending of a name, the first that OpenCV has is used, with their names. Browsers play all but the last
# of .mp4. VP8 takes a third of the time of VP9 and 1.6 times the space.
ENCODERS = {
    ".mp4": (("vp09", "VP9"), ("mp4v", "MPEG-4")),
    ".webm": (("VP80", "VP8"), ("VP90", "VP9")),
}
H264 = "H.264"  # of .mp4 where the program ffmpeg is at hand: nearly every program plays it
MAX_VIDEO_PIXELS = 1 << 23  # of a frame, a little more than 3840 x 2160: encoders take 150 bytes for each
OPENCV = "opencv-contrib-python-headless"
FOLDER = "name a folder instead, for one picture a frame"


def to_picture(image: np.ndarray) -> Picture:
    """Convert a picture ``[h,w,3]``, float in [0, 1], to 8 bit RGB."""
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def save_picture(path: Path, picture: Picture, *settings: int, overwrite: bool = True) -> None:
    """Write a picture in the format of the file name; ``settings`` go to :func:`cv2.imencode`."""
    _, data = cv2.imencode(path.suffix, picture[..., ::-1], settings)
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(data.tobytes())


def picture_html(picture: Picture, text: str) -> str:
    """Convert a picture to an HTML element for notebooks; ``text`` is its description."""
    data = base64.b64encode(cv2.imencode(".png", picture[..., ::-1])[1].tobytes()).decode("ascii")
    return f'<img alt="{html.escape(text)}" src="data:image/png;base64,{data}">'


def label(picture: Picture, text: str) -> Picture:
    """Put a dark band with one line of text above a picture, shortening the text to fit."""
    text = text.encode("utf-8", "replace").decode()  # OpenCV does not survive halves of characters
    face, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.42
    while len(text) > 1 and cv2.getTextSize(text, face, scale, 1)[0][0] > picture.shape[1] - 8:
        text = text[:-1]
    band = np.full((BAND, picture.shape[1], 3), 32, np.uint8)
    cv2.putText(band, text, (4, BAND - 7), face, scale, (235, 235, 235), 1, cv2.LINE_AA)
    return np.concatenate([band, picture])


def view_pictures(
    scenes: Sequence[tuple[str, Gaussians]],
    cameras: Cameras,
    photos: np.ndarray | None = None,
    *,
    max_views: int = 4,
    **drawing: Any,
) -> list[list[tuple[str, Picture]]]:
    """Render each scene in at most ``max_views`` views, in rows that begin with the photo if there is one.

    Every picture comes with a line of text: its name, its number of Gaussians, and its PSNR against the
    photo ``[c,h,w,3]``, or without photos against the first scene. ``drawing`` is passed on to :func:`gsmerge.render`.
    """
    ids = pick_views(len(cameras), max_views)
    renders = [render(gaussians, cameras[ids], **drawing).images.clip(0, 1) for _, gaussians in scenes]
    views = []
    for row, view in enumerate(ids):
        columns = [(f"{name}: {len(part):,}", drawn[row]) for (name, part), drawn in zip(scenes, renders, strict=True)]
        if photos is not None:
            columns.insert(0, (f"photo, view {view}", photos[view]))
        first, *others = columns
        compared = [(f"{text}, {psnr(image, first[1]):.1f} dB", image) for text, image in others]
        views.append([(text, to_picture(image)) for text, image in (first, *compared)])
    return views


def outside_pictures(
    scenes: Sequence[tuple[str, Gaussians]], cameras: Cameras, *, photos: bool, **drawing: Any
) -> list[tuple[str, Picture]]:
    """Render each scene from outside the capture, as one row like those of :func:`view_pictures`.

    Every picture comes with its name. With ``photos`` a white picture comes first, in the photos' column.
    """
    camera, _ = outside_camera(cameras, scenes[0][1].means)
    renders = [(f"{name}: {OUTSIDE}", to_picture(render(scene, camera, **drawing).images[0])) for name, scene in scenes]
    return [(f"{OUTSIDE}: no photo", np.full_like(renders[0][1], 255))] * photos + renders


def contact_sheet(views: Sequence[Sequence[tuple[str, Picture]]], *, min_width: int = 320) -> Picture:
    """Arrange pictures in a sheet: one labelled row per view.

    Small pictures are enlarged by a whole factor so that each has at least ``min_width`` columns.
    """
    factor = max(1, -(-min_width // views[0][0][1].shape[1]))
    rows = []
    for pictures in views:
        tiles = [(text, np.repeat(np.repeat(picture, factor, 0), factor, 1)) for text, picture in pictures]
        rows.append(_join([label(picture, text) for text, picture in tiles], axis=1))
    return _join(rows, axis=0)


def _join(pictures: Sequence[Picture], axis: int) -> Picture:
    """Put pictures in a row or a column, with a gap between."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, 255, np.uint8)
    out = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(out, axis)


def draw_borders(image: np.ndarray, labels: np.ndarray) -> Picture:
    """Draw the borders between superpixels ``[h,w]`` in yellow over a photo ``[h,w,3]``, sRGB in [0, 1]."""
    picture = to_picture(image)
    picture[borders(labels)] = BORDER_COLOR
    return picture


def borders(labels: np.ndarray) -> np.ndarray:
    """Return a mask ``[h,w]`` of pixels whose left or upper neighbour has another label ``[h,w]``."""
    border = np.zeros(labels.shape, bool)
    border[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    border[1:] |= labels[1:] != labels[:-1]
    return border


def draw_means(image: np.ndarray, labels: np.ndarray) -> Picture:
    """Fill each superpixel of ``labels [h,w]`` with its mean colour in ``image [h,w,3]``, sRGB in [0, 1]."""
    return to_picture(mean_colors(image, labels)[labels])


def mean_colors(image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the mean colour ``[k,3]`` of each superpixel of ``labels [h,w]`` in ``image [h,w,3]``."""
    flat = labels.reshape(-1)
    sizes = np.maximum(np.bincount(flat), 1)
    return np.stack([np.bincount(flat, channel) / sizes for channel in image.reshape(-1, 3).T], 1)


def draw_heat(values: np.ndarray) -> Picture:
    """Draw non-negative values ``[h,w]`` as a heat map whose maximum is the 99th percentile."""
    values = values.astype(np.float64)
    return heat_map((values / (np.quantile(values, 0.99) or 1.0)).clip(0, 1))


def heat_map(levels: np.ndarray) -> Picture:
    """Colour levels ``[h,w]`` in [0, 1] from black through red to yellow."""
    colored = cv2.applyColorMap((levels * 255).round().astype(np.uint8), cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(colored[..., ::-1], np.uint8)


class FfmpegWriter:
    """Write frames as H.264 with the program ffmpeg, by the calls of :class:`cv2.VideoWriter`."""

    def __init__(self, program: str, path: Path, size: tuple[int, int], fps: int) -> None:
        frames = ("-f", "rawvideo", "-pix_fmt", "bgr24", "-s", "{}x{}".format(*size), "-r", str(fps), "-i", "-")
        colors = ("-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709")  # as players expect of large frames
        encoding = ("-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4")
        command = (program, "-v", "quiet", "-y", *frames, *colors, *encoding, str(path))
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)

    def write(self, frame: np.ndarray) -> None:
        """Add a frame ``[h,w,3]`` in the order blue, green, red."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended: the frames that are missing are counted later
            self.process.stdin.write(np.ascontiguousarray(frame).tobytes())

    def release(self) -> None:
        """Finish the file."""
        with suppress(BrokenPipeError):
            self.process.communicate()


def find_ffmpeg() -> str | None:
    """Find a program ffmpeg that encodes H.264 on the PATH; None if there is none."""
    program = shutil.which("ffmpeg")
    with suppress(OSError):
        if program is not None:
            listed = subprocess.run((program, "-hide_banner", "-encoders"), capture_output=True, check=False).stdout
            return program if b" libx264 " in listed else None
    return None


def is_video(path: Path) -> bool:
    """Return whether a file name has the ending of a video format that can be written."""
    return path.suffix.lower() in ENCODERS


def write_video(path: StrPath, frames: Iterable[Picture], fps: int, *, overwrite: bool = False) -> str:
    """Write pictures ``[h,w,3]`` of one size as a video, and return the name of its encoding.

    A ``.mp4`` is H.264 if :func:`find_ffmpeg` finds a program for it; otherwise the first encoding that OpenCV has is
    used.

    One frame is in memory at a time. Odd sides get one more row or column, a copy of the last, since encodings require
    even sides. SceneError if OpenCV has no encoder for the ending of the name, or the file cannot be written
    completely.
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


def _open_writer(path: Path, temporary: Path, first: Picture, fps: int) -> tuple[cv2.VideoWriter | FfmpegWriter, str]:
    """Open a file with the first available encoder; also return the name of its encoding."""
    height, width = first.shape[:2]
    if path.suffix.lower() == ".mp4" and (program := find_ffmpeg()):
        return FfmpegWriter(program, temporary, (width, height), fps), H264
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
