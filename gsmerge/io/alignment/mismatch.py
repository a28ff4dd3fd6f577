"""What to say where Gaussians and cameras do not belong together."""

from __future__ import annotations

from gsmerge.errors import SceneError
from gsmerge.io.alignment.verify import Alignment
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.ply import PlyInfo

ASPECT_TOLERANCE = 0.04  # backbones round each side to a multiple of 14 by itself


def count_problem(ply: PlyInfo, views: int, width: int, height: int) -> str:
    """That the number of rows is not that of the pixels."""
    pixels = width * height
    return (
        f"expected one Gaussian per pixel, {views} x {height} x {width} = {views * pixels} (views x height x width), "
        f"found {ply.count}"
    )


def other_grid(count: int, views: int, width: int, height: int) -> str:
    """Which simple reading the number of Gaussians has instead."""
    pixels = width * height
    if count % (views * pixels) == 0:
        return f"that is {count // (views * pixels)} Gaussians per pixel"
    if count % pixels == 0:
        return f"that is {count // pixels} views of this size: give the cameras of just those"
    if count == views * (width - 16) * (height - 16):
        return f"that is {height - 16} x {width - 16} per view: 8 pixels were trimmed at every border"
    each = count / views
    guess = round((each * width / height) ** 0.5)
    for w in range(max(1, guess - 14), guess + 15):
        h = each / w
        if h == round(h) and h and abs(w * height / (h * width) - 1) < ASPECT_TOLERANCE:
            return f"that is {round(h)} x {w} per view: give cameras and images of that size"
    if count < views * pixels:
        return "pixels were dropped or merged by the exporter, which is not supported"
    return "give the cameras and images that belong to it"


def misaligned(camera_file: CameraFile, alignment: Alignment, reason: str | None) -> SceneError:
    """That the rows would be enough, but do not lie where their pixels look."""
    measured = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {alignment.worst_px:.1f} px and "
        f"{100 * alignment.share_in_front:.0f} % in front of their camera"
    )
    unknown = "no other convention fits either: give the cameras that belong to the .ply"
    return SceneError(camera_file.path, measured, f"{reason}: convert one to the other" if reason else unknown)
