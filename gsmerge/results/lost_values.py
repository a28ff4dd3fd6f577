"""Find the values that the format of an output cannot hold, and measure in pictures what the file loses by them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsmerge.drawing.render_views import near_plane
from gsmerge.errors import Doubt
from gsmerge.frozen import replace
from gsmerge.io.formats.table import FILES, Format, Held, output_format
from gsmerge.io.formats.write import output_notes
from gsmerge.io.photo_files import limit_size
from gsmerge.method.geometry.views import even_views, resize_cameras
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import decibels
from gsmerge.method.viewpoints.place_cameras import place_viewpoints
from gsmerge.settings.setting import join_words
from gsmerge.types import Cameras, Gaussians, StrPath

# PSNR (dB) of pictures that differ as much as a picture and its copy of 8 bits: smaller differences are not visible
ROUNDING_PSNR = decibels(1 / 12 / 255**2)
# The file and the scene are compared in at most this many pictures, whose longer side has this many pixels
MOST_PICTURES = 4
LONGER_SIDE = 320
_NAMES = {"scales": "sizes", "opacities": "opacities", "sh0": "colours (f_dc)", "shN": "harmonics"}


def format_notes(path: StrPath, gaussians: Gaussians, cameras: Cameras) -> list[str]:
    """Note what the format of a path leaves out, how far it moves Gaussians, and which values it cannot hold.

    ``cameras`` are those of the scene; without cameras, pictures are drawn from places around and inside the scene.
    Raises UsageError if no format has the ending of the path.
    """
    return output_notes(path, gaussians) + describe_lost_values(path, gaussians, cameras)


def describe_lost_values(path: StrPath, gaussians: Gaussians, cameras: Cameras) -> list[str]:
    """Note how many Gaussians have values that the format of a path cannot hold, if pictures show a difference."""
    format_ = output_format(path)
    columns = gaussians.numpy()
    lost = find_lost_values(columns, format_)
    if not lost:
        return []
    psnr = _compare_pictures(columns, format_.values, cameras)
    if psnr >= ROUNDING_PSNR:
        return []
    share = 100 * float(np.logical_or.reduce(list(lost.values())).mean())
    limits = " and ".join(_describe(name, format_.values[name], columns) for name in lost)
    others = [
        row.ending
        for row in FILES
        if row.max_degree >= gaussians.sh_degree and row.read is not None and not find_lost_values(columns, row)
    ]
    remedy = f"; {join_words(others)} holds them" if others else ""
    problem = f"{share:.2g} % of the Gaussians have values that {format_.ending} cannot hold ({limits})"
    return [Doubt(f"{problem}, and pictures of the file are {psnr:.1f} dB from the scene's{remedy}")]


def find_lost_values(gaussians: Gaussians, format_: Format) -> dict[str, np.ndarray]:
    """Return the Gaussians ``[n]`` with values that a format cannot hold, by attribute; only attributes with some.

    A Gaussian is too large by its largest scale, and too small by the second largest, since a flat Gaussian looks the
    same however thin it is.
    """
    found = dict[str, np.ndarray]()
    for name, held in format_.values.items():
        values = getattr(gaussians, name).reshape(len(gaussians), -1)
        if not values.size or (values.min() >= held.low and values.max() <= held.high):  # of most scenes
            continue
        low = np.sort(values, axis=1)[:, 1:2] if name == "scales" else values
        tolerance = 0.5 * held.step  # rounding to the nearest number changes other values as much
        factor = 1 + tolerance
        if name == "scales":
            is_lost = (low * factor < held.low) | (values > held.high * factor)
        else:
            is_lost = (low < held.low - tolerance) | (values > held.high + tolerance)
        is_lost = is_lost.any(axis=1)
        if is_lost.any():
            found[name] = is_lost
    return found


def _compare_pictures(gaussians: Gaussians, values: Mapping[str, Held], cameras: Cameras) -> float:
    """Return the PSNR (dB) between pictures of Gaussians, and of these with the nearest ``values`` that are held."""
    cameras = cameras.numpy() if len(cameras) else place_viewpoints(gaussians)
    cameras = cameras[even_views(len(cameras), min(len(cameras), MOST_PICTURES))]
    cameras = resize_cameras(cameras, *limit_size((cameras.width, cameras.height), LONGER_SIDE))
    clipped = {
        name: np.clip(getattr(gaussians, name), np.float32(held.low), np.float32(held.high))
        for name, held in values.items()
    }
    near = near_plane(gaussians, cameras)
    before = render(gaussians, cameras, near=near).images.clip(0, 1)
    after = render(replace(gaussians, **clipped), cameras, near=near).images.clip(0, 1)
    return decibels(float(np.square(before - after, dtype=np.float64).mean()))


def _describe(name: str, held: Held, gaussians: Gaussians) -> str:
    """Describe the limit of an attribute that Gaussians exceed, such as "sizes above 379"."""
    limits = f"beyond {held.low:.3g} to {held.high:.3g}"
    if name == "scales":
        limits = f"above {held.high:.3g}" if gaussians.scales.max() > held.high else f"below {held.low:.2g}"
    return f"{_NAMES[name]} {limits}"
