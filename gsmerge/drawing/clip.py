"""Write clips as a video or a GIF: scenes from the same cameras, separated by moving lines, with captions."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
from PIL import Image

from gsmerge.drawing.preview import FACE, BytePicture, shorten_text
from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass
from gsmerge.io import atomic_output
from gsmerge.io.image_names import CLIP_ENDS
from gsmerge.method.kernels.elementary import sin
from gsmerge.settings.files import GIF
from gsmerge.types import StrPath

# Code and name of the encoders for each ending. The first encoder that OpenCV has is used. Browsers play all but
# MPEG-4. VP8 takes a third of the time of VP9, and its files are 1.6 times as large
ENCODERS = {".mp4": (("vp09", "VP9"), ("mp4v", "MPEG-4")), ".webm": (("VP80", "VP8"), ("VP90", "VP9"))}
# Name, encoder, container and options of the encoding that the program ffmpeg makes. Nearly every program plays H.264
H264 = ("H.264", "libx264", "mp4", (
    "-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709",  # the colours that players expect of large frames
    "-preset", "veryfast", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart",
))  # fmt: skip
MAX_VIDEO_PIXELS = 1 << 23  # per frame, a little more than 3840 x 2160; encoders take 150 bytes per pixel
MAX_GIF_PIXELS = 1 << 27  # in all frames; more take over 400 MB of memory, and make files too large to send
GIF_SAMPLE = 1 << 20  # approximate number of pixels from which the palette of a GIF is made
OPENCV = "opencv-contrib-python-headless"
FOLDER_HINT = "name a folder instead, for one picture a frame"
LINE = 32  # height of a line of text at scale 1, pixels


@dataclass(frozen=True, eq=False)
class Caption:
    """Text on a dark box in a frame."""

    left: int  # pixels
    top: int  # pixels
    text: np.ndarray  # [h,w,1] share of each pixel that is text, 0 to 1

    def draw(self, picture: BytePicture) -> None:
        """Draw the caption into a picture."""
        height, width = self.text.shape[:2]
        box = picture[self.top : self.top + height, self.left : self.left + width]
        text = self.text[: box.shape[0], : box.shape[1]]  # the part inside a tiny frame
        # brightness of the picture behind a caption, and level of its text
        shade = 0.35
        text_level = 245
        box[:] = (shade * box * (1 - text) + text_level * text).round()


def make_captions(texts: Sequence[tuple[str, str, str]], width: int, height: int) -> list[Caption]:
    """Place the captions of scenes side by side at the bottom of a frame, from left to right.

    ``texts`` are the name, the count and the size of each scene. If there is room, count and size share a line,
    otherwise each has a line. A count that is too wide for a line is broken between its words. A name may be shortened.
    Other lines that do not fit are left out.
    """
    scale, thickness = max(0.45, height / 900), max(1, round(height / 600))
    line_height = round(LINE * scale)
    margin = line_height // 2
    max_width = width // len(texts) - 2 * line_height

    def text_width(text: str) -> int:
        """Return the width of a text at the present ``scale``, in pixels."""
        return int(cv2.getTextSize(text, FACE, scale, thickness)[0][0])

    def widest(rows: Sequence[Sequence[str]]) -> int:
        """Return the largest width of a text, except for the names, which may be shortened."""
        return max(text_width(text) for row in rows for text in row[1:])

    rows: list[tuple[str, ...]] = [(name, f"{count}, {size}") for name, count, size in texts]
    if widest(rows) > max_width:
        rows = list(texts)
    min_shrink = 0.6  # captions that are too wide become smaller, but not by less than this factor
    if min_shrink * widest(rows) > 0.95 * max_width:
        rows = [(name, *count.split(), size) for name, count, size in texts]
    scale *= min(1.0, max(min_shrink, 0.95 * max_width / widest(rows)))
    captions = []
    for i, (name, *others) in enumerate(rows):
        lines = [shorten_text(name, max_width, scale, thickness)]
        lines += [text for text in others if text_width(text) <= max_width]
        box = np.zeros((line_height * len(lines) + margin, max(map(text_width, lines)) + 2 * margin), np.uint8)
        for number, text in enumerate(lines, 1):
            start = margin, number * line_height - margin // 4
            cv2.putText(box, text, start, FACE, scale, 255, thickness, cv2.LINE_AA)
        left = margin + (width - box.shape[1] - 2 * margin) * i // max(len(rows) - 1, 1)
        captions.append(Caption(max(left, 0), max(height - margin - len(box), 0), box[..., None] / np.float32(255)))
    return captions


def swipe_borders(count: int, frames: int, fps: float, width: int) -> list[list[int]]:
    """Return where the borders of ``count`` scenes are in each frame of a clip that is ``width`` pixels wide.

    Element ``[frame][i]`` is the left border of scene i, and the right border of scene i - 1: a column of pixels. The
    inner borders begin evenly spread. All inner borders move together to the right, to the left, and back.
    """
    swipe_seconds = 6  # time in which a border moves to both sides and back
    rounds = max(1, round(frames / fps / swipe_seconds))
    swipe_share = 0.9  # a border moves by this share of its distance from the next one
    shifts = swipe_share * sin(2 * np.pi * rounds * np.arange(frames) / frames)
    borders = (np.arange(count + 1) + shifts[:, None]) * width / count
    borders[:, 0] = 0
    borders[:, -1] = width
    return [list(map(int, row)) for row in borders.round()]


def draw_swipe(pictures: Sequence[BytePicture], borders: Sequence[int], captions: Sequence[Caption]) -> BytePicture:
    """Make a frame from columns of pictures of several scenes, each with its caption, and draw lines between them.

    All pictures are from one camera. ``borders`` are the borders of the columns, see :func:`swipe_borders`. The
    captions are drawn into the pictures themselves.
    """
    frame = np.empty_like(pictures[0])
    lines_per_width = 480  # a line is as wide as a frame divided by this
    half = max(1, frame.shape[1] // (2 * lines_per_width))
    for picture, caption, left, right in zip(pictures, captions, borders[:-1], borders[1:], strict=True):
        caption.draw(picture)
        frame[:, left:right] = picture[:, left:right]
    for border in borders[1:-1]:
        frame[:, max(border - 2 * half, 0) : border + 2 * half] //= 2  # a shadow on both sides of the white line
        frame[:, max(border - half, 0) : border + half] = 255
    return frame


class FfmpegWriter:
    """Writer of frames with the program ffmpeg, with the methods of :class:`cv2.VideoWriter`."""

    def __init__(self, program: str, path: Path, shape: tuple[int, ...], fps: float) -> None:
        """Start the ``program``, which writes frames of ``shape [h,w,c]`` to a file."""
        height, width, _ = shape
        frames = ("-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-")
        _, encoder, container, encoding = H264
        command = (program, "-v", "quiet", "-y", *frames, "-c:v", encoder, *encoding, "-f", container, str(path))
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)

    def write(self, frame: np.ndarray) -> None:
        """Add a frame ``[h,w,c]`` in the order blue, green, red."""
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # ffmpeg has ended too early, which _check_frames reports
            self.process.stdin.write(np.ascontiguousarray(frame).tobytes())

    def release(self) -> None:
        """Finish the file."""
        with suppress(BrokenPipeError):
            self.process.communicate()


def find_ffmpeg(encoder: str) -> str | None:
    """Find the program ffmpeg on the PATH. Returns None if the program is missing, or does not have the ``encoder``."""
    program = shutil.which("ffmpeg")
    with suppress(OSError):
        if program is not None:
            listed = subprocess.run((program, "-hide_banner", "-encoders"), capture_output=True, check=False).stdout
            return program if f" {encoder} ".encode() in listed else None
    return None


def stored_size(path: StrPath, width: int, height: int) -> tuple[int, int]:
    """Return width and height of the frames in a file. Videos have even sides, since two pixels share a colour."""
    if Path(path).suffix.lower() == GIF:
        return width, height
    return width + width % 2, height + height % 2


def write_clip(path: StrPath, frames: Iterable[BytePicture], fps: float, *, overwrite: bool = False) -> str:
    """Write pictures ``[h,w,3]`` of one size as a video or a GIF; return the name of the file's encoding.

    A ``.mp4`` has the encoding H.264 if :func:`find_ffmpeg` finds a program for H.264, otherwise the first encoding
    that OpenCV has. All frames of a GIF share a palette, and are in memory together. A video takes the memory of a few
    frames. The frames of a video have the :func:`stored_size`: an odd side gets one more row or column, a copy of the
    last one.

    Raises SceneError if there is no encoder for the ending of the name, or if the file cannot be written completely.
    """
    path = Path(path)
    with atomic_output(path, overwrite=overwrite) as temporary:
        if path.suffix.lower() == GIF:
            pictures = list(frames)
            # The palette comes from a sample of all frames
            step = 1 + len(pictures) * pictures[0].shape[0] * pictures[0].shape[1] // GIF_SAMPLE
            sample = np.concatenate([picture.reshape(-1, 3)[i % step :: step] for i, picture in enumerate(pictures)])
            palette = Image.fromarray(sample[None]).quantize(256, Image.Quantize.FASTOCTREE)
            # Dithering is off, because dithered frames flicker, lose 1.6 dB, and make the file a quarter larger
            gif_frames = (Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
            first, *later = gif_frames
            duration = round(1000 / fps)  # ms
            first.save(temporary, "GIF", save_all=True, append_images=later, duration=duration, loop=0)
            return "GIF"
        if str(temporary).encode(errors="ignore") != os.fsencode(temporary):
            raise SceneError(path, "expected a folder whose name is UTF-8, as OpenCV needs it for videos", FOLDER_HINT)
        even_frames = (
            np.pad(frame, [(0, side % 2) for side in frame.shape[:2]] + [(0, 0)], mode="edge") for frame in frames
        )
        first_frame = next(even_frames)
        writer, encoding = _open_writer(path, temporary, first_frame.shape, fps)
        written: list[Future[None]] = []

        def encode(frame: BytePicture) -> None:
            """Add a frame in the order of channels that OpenCV takes."""
            writer.write(frame[..., ::-1])

        try:
            with ThreadPoolExecutor(1) as encoder:  # encode on one thread, while the next frame is drawn
                for frame in chain([first_frame], even_frames):
                    if written:
                        written[-1].result()
                    written.append(encoder.submit(encode, frame))
        except BaseException:
            # Closing takes seconds, and need not be waited for, since the file is removed
            closing = Thread(target=writer.release, daemon=True)
            closing.start()
            if os.name == "nt":  # Windows cannot remove an open file
                closing.join()
            raise
        with _silent_stderr():
            writer.release()
        _check_frames(path, temporary, len(written))
        with temporary.open("ab") as file:
            file.write(CLIP_ENDS[path.suffix.lower()])
    return encoding


def _open_writer(
    path: Path, temporary: Path, shape: tuple[int, ...], fps: float
) -> tuple[cv2.VideoWriter | FfmpegWriter, str]:
    """Open the file ``temporary`` with the first available encoder; return the writer, and the encoding's name.

    All frames have ``shape``. ``path`` is the name that the file will get: the ending of ``path`` decides about the
    encoders, and messages name ``path``.
    """
    height, width, _ = shape
    name, encoder, container, _ = H264
    if path.suffix.lower() == f".{container}" and (program := find_ffmpeg(encoder)):
        return FfmpegWriter(program, temporary, shape, fps), name
    encoders = ENCODERS[path.suffix.lower()]
    for code, name in encoders:
        with _silent_stderr():
            fourcc = cv2.VideoWriter.fourcc(*code)
            writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, fourcc, fps, (width, height))
        if writer.isOpened():
            return writer, name
    os.stat(str(temporary))  # if the folder has vanished, this raises an error with the reason
    raise SceneError(
        path,
        f"this OpenCV has none of the encoders {' and '.join(name for _, name in encoders)}, so it cannot write it",
        f"{FOLDER_HINT}, or install {OPENCV}",
    )


def _check_frames(path: Path, temporary: Path, count: int) -> None:
    """Raise SceneError unless ``count`` frames of a video can be read, since encoders do not report a full disk."""
    with _silent_stderr():
        reader = cv2.VideoCapture(str(temporary), cv2.CAP_FFMPEG)
        readable = 0
        while reader.grab():
            readable += 1
        reader.release()
    if readable != count:
        os.stat(str(temporary))  # if the folder has vanished, this raises an error with the reason
        problem = f"could not be written completely, {readable} of {count} frames can be read"
        raise SceneError(path, problem, "free some space, or write elsewhere")


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Suppress messages that OpenCV and FFmpeg write to the descriptor of stderr."""
    try:
        stderr = os.dup(2)
    except OSError:  # stderr is closed, so nothing is printed
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        with suppress(OSError, ValueError, AttributeError):
            sys.stderr.flush()
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(sink)
        os.close(stderr)
