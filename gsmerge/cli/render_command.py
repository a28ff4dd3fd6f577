"""``gsmerge render``: draw pictures of scenes from their cameras, and clips along paths."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_folder, check_outputs, input_files
from gsmerge.errors import UsageError
from gsmerge.settings.files import CLIPS, PICTURES
from gsmerge.settings.reading import NONE
from gsmerge.settings.setting import Setting

MAX_SIDE = 1 << 20  # pixels; larger than any camera, so that pictures keep the size of the cameras


def parse_size(text: str) -> tuple[int, int]:
    """Parse ``--size``: width and height, separated by an x."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    sides = (16, 16384)  # least and largest width and height of a picture, pixels
    if not all(sides[0] <= side <= sides[1] for side in size):
        expected = f"WIDTHxHEIGHT, such as 1920x1080, {sides[0]} to {sides[1]} pixels each"
        raise ValueError(f"expected {expected}, got {text!r}")
    return size


def parse_views(text: str) -> int | str:
    """Parse ``--views``: a number or the name of a view. Digits that begin with 0 are a name."""
    if not re.fullmatch(r"[+-]?[\d.]+", text) or re.fullmatch(r"0\d+", text):
        return text
    max_digits = 9  # of a longer number only this many digits are read, which is still more than enough views
    count = int(text[:max_digits]) if text.isdecimal() else 0
    if count < 1:
        raise ValueError(f"expected a number from 1 or the name of a view, got {text}")
    return count


FRAMES = Setting("Number of frames of a clip, at 30 frames per second, or 12.5 in a GIF.", kind=int, least=2,
                 most=100_000)  # fmt: skip
BACKGROUND = Setting("Grey level behind the scene, 0 to 1; or none: a .png or .webp of one scene is transparent, other "
                     "pictures show a chequered ground.", kind=float | Literal["none"], least=0, most=1)  # fmt: skip


def render(
    scenes: Annotated[list[Path], opt.argument("SCENES...", "Files of Gaussians: before, after, ... The first may be a "
        "folder.")],
    *,
    cameras: opt.Cameras = None, images: opt.Images = None, hint: opt.Hint = None,
    output: Annotated[Path, opt.output("A picture, .png, .jpg or .webp: a panel of photos and scenes, or with --views "
        "NAME one view of one scene. A clip, .mp4, .webm or .gif; a moving line separates two scenes. A folder gets a "
        "picture of each camera.")],
    path: Annotated[str | None, opt.option(opt.OUTPUT, "orbit|spline|FILE", "Path of the camera. orbit: about the "
        "middle view, orbit:45 by 45 degrees to each side; spline: through all views. With ,back:0.5 it moves back by "
        "half of the depth. Or a file with a camera for each frame.", default="orbit, none for a folder")] = None,
    size: Annotated[opt.Parsed | None, opt.option(opt.OUTPUT, "WIDTHxHEIGHT", "Width and height in pixels, in a panel "
        "of each picture. Views with another aspect ratio are cropped on two sides.", read=opt.reader(parse_size),
        default="the cameras', of a GIF at most 640")] = None,
    frames: Annotated[opt.Parsed | None, opt.option(opt.OUTPUT, "NUMBER", FRAMES.help, read=opt.reader(FRAMES.read),
        default="4 seconds")] = None,
    views: Annotated[opt.Parsed | None, opt.option(opt.OUTPUT, "NUMBER|NAME", "Largest number of views, at "
        "equal intervals; or the name of one view, such as 00006 or 6.jpg (6 would be a number).",
        read=opt.reader(parse_views), default="4 on a panel, else all")] = None,
    background: Annotated[opt.Parsed | None, opt.option(opt.OUTPUT, "LEVEL|none", BACKGROUND.help,
        default="none in a panel, else 0", read=opt.reader(BACKGROUND.read))] = None,
    overwrite: opt.Overwrite = False, threads: opt.OwnThreads = None, json: opt.Json = False,
    progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Draw scenes: a clip of before and after, a panel with the photos, or a picture for each camera."""
    kind = _choose_kind(output, scenes, path, frames, views)
    path = path or ("orbit" if kind == "path" else None)
    from gsmerge.drawing import render_files as drawings
    from gsmerge.drawing.camera_path import parse_camera_path
    from gsmerge.reading.scene_files import find_scene_files
    from gsmerge.runtime.documents import document_head, note_entries

    files = find_scene_files(scenes[0], cameras=cameras, images=images)
    framing = drawings.frame_files(files, cameras, images)
    inputs = (*scenes, *input_files(files), *input_files(framing))
    if path is not None and parse_camera_path(path) is None:  # the path is a file
        inputs = (*inputs, Path(path))
    if output.suffix.lower() in (*PICTURES, *CLIPS):
        # A picture in the folder of a scene may be replaced, unless it is a photo of this scene
        read = [one for one in inputs if one not in scenes or not one.is_dir()]
        check_outputs((output,), (*read, files.images), overwrite=overwrite)
    else:
        check_folder(output, inputs, overwrite=overwrite)
    reading = opt.read_hints(hint, **({"max_side": MAX_SIDE} if kind == "views" else {}))
    level = None if background == NONE or (background is None and kind == "panel") else background or 0.0
    options = drawings.DrawOptions(
        files, scenes, framing, output, views=views, path=path, frames=frames, size=size, background=level,
        opacity=reading.opacity, hints=reading.hints,
    )  # fmt: skip
    drawing = drawings.DRAWINGS[kind](options)
    document = {**document_head(), "output": str(output), "pictures": [str(picture) for picture in drawing.paths]}
    document |= drawing.facts | note_entries(drawing.facts["notes"])
    say_notes(document["notes"], quiet=quiet or json)
    with stage_progress(quiet=quiet or json) as on_step:
        document |= drawings.write_drawing(drawing, overwrite=overwrite, progress=on_step)
    line = f"{output}: {drawings.drawing_line(document)}"
    print_document(document, line, as_json=json, quiet=quiet)


def _choose_kind(output: Path, scenes: Sequence[Path], path: str | None, frames: Any, views: Any) -> str:
    """Return the kind of drawing, by the name of the output and the options.

    Raises UsageError if output and options do not fit each other. A clip without a ``path`` gets the path "orbit".
    """
    suffix = output.suffix.lower()
    is_clip = suffix in CLIPS
    is_picture = suffix in PICTURES
    if suffix and not is_clip and not is_picture and not output.is_dir():
        expected = f"a picture, {opt.join_words(PICTURES)}, a clip, {opt.join_words(CLIPS)}, or a folder"
        raise UsageError(f"{output}: expected {expected}")
    if is_clip or path is not None:
        if is_picture:
            raise UsageError(f"{output}: expected a clip, {opt.join_words(CLIPS)}, or a folder with --path")
        if isinstance(views, str):
            raise UsageError("--views: expected a number of views for a clip or a --path, got a name")
        if path is None:
            return "path"
        from gsmerge.drawing.camera_path import parse_camera_path

        with opt.usage_errors():
            is_file = parse_camera_path(path) is None
        if is_file and not Path(path).exists():
            raise UsageError(f"--path {path}: expected orbit, spline or a file of cameras, found no such file")
        if is_file and frames is not None:
            raise UsageError("--frames: expected orbit or spline; with a file of cameras, use --views")
        return "path"
    if frames is not None:
        raise UsageError(f"--frames: expected a clip, {opt.join_words(CLIPS)}, or a --path with it")
    is_single = isinstance(views, str) and len(scenes) == 1
    return "panel" if is_picture and not is_single else "views"
