"""An inspection -> lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsmerge.runtime.estimate import memory_problems
from gsmerge.runtime.memory import human_bytes

_CAMERA_ELEMENTS = ("extrinsic", "intrinsic", "image_size")
_REPEATED = ("read as: ", "the rows belong to no pixels")  # notes that repeat a line of their own
_ENCODINGS = {"logit": "as logits", "raw": "in [0, 1]"}


def inspection_lines(scene: Mapping[str, Any]) -> list[str]:
    """An inspection, as of ``Inspection.to_dict()``, for people."""
    parts = ", ".join(f"{name} {human_bytes(size)}" for name, size in scene["bytes_by_attribute"].items())
    ignored = _ignored(scene)
    low, high = (" ".join(f"{value:.4g}" for value in scene[key]) for key in ("box_low", "box_high"))
    size = scene["extents"]
    lines = [
        f"file       {scene['path']}: {human_bytes(scene['bytes'])} ({parts})",
        f"layout     {scene['layout']}, {scene['format']}; opacity stored {_ENCODINGS[scene['opacity_encoding']]}",
        f"exporter   {scene['exporter']}",
        f"ignored    {', '.join(ignored)}" if ignored else "",
        f"Gaussians  {scene['count']:,}: {scene['num_nonfinite']} not finite, {scene['num_transparent']:,} transparent,"
        f" {scene['num_opaque']:,} opaque, {scene['num_saturated']:,} of opacity 0 or 1",
        f"extent     {low}  to  {high}  (1 % to 99 %); {100 * size['share_outliers']:.2g} % beyond ten times that box",
        f"floaters   about {round(size['share_floaters'] * scene['count']):,}: isolated, or beyond that;"
        " compact --drop-floaters leaves them out",
        f"sky        in {scene['num_sky_views']} photos; compact --drop-sky leaves it out"
        if scene["num_sky_views"]
        else "",
        f"scales     median {size['scale_median']:.3g}, largest {size['scale_max']:.3g} in a scene of"
        f" {size['diagonal']:.3g}; {100 * size['share_huge']:.2g} % above a tenth of it",
        f"cameras    {_cameras(scene)}",
        f"images     {scene['images'] or 'none found'}",
    ]
    lines += _alignment_lines(scene) + _view_lines(scene) + _estimate_lines(scene)
    repeated = () if scene["alignment_problem"] is None and scene["rows"] is None else _REPEATED
    notes = [note for note in scene["notes"] if not note.startswith(repeated)]
    return [line for line in lines if line] + [f"note       {note}" for note in notes]


def _ignored(scene: Mapping[str, Any]) -> list[str]:
    """Columns and elements that mean nothing here; those that hold the camera do."""
    used = _CAMERA_ELEMENTS if scene["cameras"] is None and scene["camera_format"] else ()
    elements = [name for name in scene["extra_elements"] if name not in used]
    return [*scene["extra_columns"], *(f"element {name}" for name in elements)]


def _cameras(scene: Mapping[str, Any]) -> str:
    if not scene["num_views"]:
        return scene["cameras"] or "none found"
    inside = set(_CAMERA_ELEMENTS) <= set(scene["extra_elements"])
    where = scene["cameras"] or ("inside the .ply" if inside else "none found")
    return f"{where}: {scene['num_views']} ({scene['camera_format']})"


def _alignment_lines(scene: Mapping[str, Any]) -> list[str]:
    """Which row is which pixel, and how far from it; or why that is not known."""
    alignment, problem = scene["alignment"], scene["alignment_problem"]
    if problem is not None and scene["estimate"] is None:
        return [f"alignment  not measured: {problem}"]
    if problem is not None:
        return [f"alignment  not one Gaussian per pixel: {problem.removeprefix('expected one Gaussian per pixel, ')}"]
    if alignment is None:
        return []
    worst = max(m for m in alignment["median_px"] if m is not None)
    number = "one Gaussian" if scene["per_pixel"] == 1 else f"{scene['per_pixel']} Gaussians"
    missing = f", none for {scene['num_missing']:,} of them" if scene["num_missing"] else ""
    return [
        f"rows       {scene['rows']}",
        f"alignment  {number} per pixel, {scene['num_views']} x {scene['height']} x {scene['width']} (views x height x"
        f" width){missing}; median offset {worst:.2f} px in the worst view, {100 * scene['alignment_score']:.1f} %"
        " within 1 px",
    ]


def _view_lines(scene: Mapping[str, Any]) -> list[str]:
    """What the views show, and which shows least."""
    views, seen = scene["coverage"], scene["sight"]
    if not views or seen is None:
        return []
    colors = ""
    if seen["color_ratio"] is not None:
        colors = f"; colours {seen['color_ratio']:.2f} times as far from their own pixels as from any others"
    pixelwise = views[0]["share_of_pixels"] is not None
    key, what = ("share_of_pixels", "pixels") if pixelwise else ("share_of_gaussians", "Gaussians")
    shares = [view[key] for view in views]
    low, high = f"{100 * min(shares):.0f}", f"{100 * max(shares):.0f}"
    each = f"{high} % of the {what} in every view"
    if low != high:
        each = f"{low} to {high} % of the {what} per view, least in {views[shares.index(min(shares))]['name']}"
    return [f"coverage   {each}; {100 * seen['share_seen']:.0f} % of the Gaussians seen{colors}"]


def _estimate_lines(scene: Mapping[str, Any]) -> list[str]:
    estimate = scene["estimate"]
    if estimate is None:
        return ["compact    would refuse the scene as it is"]
    return [
        f"compact    would give about {estimate['num_gaussians']:,} Gaussians ({100 * estimate['ratio']:.1f} %),"
        f" {human_bytes(estimate['bytes'])}, in about {estimate['seconds']:.0f} s with"
        f" {human_bytes(estimate['memory_bytes'])} of memory",
        *(f"memory     {problem}" for problem in memory_problems(estimate)),
    ]
