"""Inspect a scene's files: one document describes their content, and the result that ``compact`` would make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from gsmerge.errors import Doubt, SceneError, attempt
from gsmerge.io import GaussianFile, file_notes, kept_comments
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.gsm import list_batches
from gsmerge.io.formats.ply import is_from_gsmerge
from gsmerge.io.formats.read_gaussians import degree_notes
from gsmerge.io.formats.rows import RESULT_COMMENT, describe_gain, read_expected_scores
from gsmerge.io.photo_files import photo_array
from gsmerge.jobs.estimate import estimate, estimate_lines
from gsmerge.method.facts.scene_size import unlike_captures
from gsmerge.method.raster.photos import LEAST_OPACITY
from gsmerge.method.stages.sky import sky_regions
from gsmerge.method.viewpoints.support import count_views_in_world
from gsmerge.plan.counts import describe_share
from gsmerge.prepare.confirm_depths import confirm_depths
from gsmerge.prepare.prepare_scene import views_notes
from gsmerge.prepare.repeats import without_repeats
from gsmerge.prepare.steps import RULES, begin, select, take_steps
from gsmerge.reading.alignment import check_cameras
from gsmerge.reading.candidates import read_scene_cameras
from gsmerge.reading.choice import candidate_lines
from gsmerge.reading.exporters import ReadHints, make_hints
from gsmerge.reading.read_scene import Loaded, find_views, finish, read_gaussian_file
from gsmerge.reading.scene_files import SceneFiles, find_scene_files
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.documents import finite, note_entries, note_lines
from gsmerge.runtime.memory import human_bytes
from gsmerge.runtime.record import record_part, report_progress
from gsmerge.runtime.threads import use_threads
from gsmerge.scoring.coverage import coverage, extents
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.reading import OpacityChoice
from gsmerge.settings.setting import join_words
from gsmerge.types import StrPath

_OWN = "gsmerge"  # exporter of files that gsmerge wrote
_FILE_KEYS = (
    "path", "layout", "format", "count", "bytes_by_attribute", "extra_columns", "extra_elements", "sh_degree",
    "opacity_encoding", "num_nonfinite", "num_empty", "num_zero_quats",
)  # fmt: skip
_UNKNOWN_KEYS = (
    "camera_format", "rows", "alignment", "alignment_problem", "sight", "compact", "auto", "agreement", "num_unseen",
)  # None unless the views are known  # fmt: skip
_CAMERA_ELEMENTS = ("extrinsic", "intrinsic", "image_size")  # elements of a .ply that hold its camera
_ENCODINGS = {"logit": "as logits", "raw": "in [0, 1]"}  # words for the encodings of opacities


@check_arguments
def inspect(
    path: StrPath,
    *,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
    opacity: OpacityChoice = "auto",
    threads: int | None = None,
    **hints: Any,
) -> dict[str, Any]:
    """Describe a scene, and measure whether it has one Gaussian per pixel.

    Args:
        path: The scene.
        cameras: As in :func:`gsmerge.read_scene`.
        images: As in :func:`gsmerge.read_scene`.
        masks: As in :func:`gsmerge.read_scene`.
        opacity: As in :func:`gsmerge.read_scene`.
        threads: Number of threads; None: one for each processor.
        hints: As in :func:`gsmerge.read_scene`.

    Returns:
        Plain JSON types, None for unknown values. About the file: ``path``, ``bytes``, ``bytes_by_attribute``,
        ``layout``, ``format``, ``exporter``, ``extra_columns``, ``extra_elements``, ``sh_degree``,
        ``opacity_encoding``, ``batches`` (of a state: ``num_views``, ``num_input``, ``num_new``, and the names of its
        ``views``), ``is_result`` (of gsmerge). About the rows: ``count``, ``num_nonfinite``, ``num_empty``,
        ``num_zero_quats``, ``num_opaque`` (from 0.995 on), ``num_transparent`` (below 1/255), ``num_saturated``
        (within 1e-6 of 0 or 1), ``extents``. About the views: ``cameras``, ``camera_format``, ``images``,
        ``num_views``, ``width``, ``height``, ``num_missing`` (pixels without a Gaussian), ``rows``
        (order of the rows), ``alignment`` or ``alignment_problem``, ``num_unseen`` (Gaussians of a result that no view
        shows), ``sight``, ``coverage``, ``num_sky_views``. ``candidates``: ``kind``, ``path``, ``chosen``, ``reason``
        and ``option`` (which takes it) of the cameras, photos and masks that may belong to the scene. ``agreement``:
        shares of the pixels whose depth other views confirm or contradict, or that no other view sees (``confirmed``,
        ``contradicted``, ``alone``). ``new_views`` of a result: ``before``, ``after``, ``low``, ``high``, see the
        report of a run. ``compact``: the estimate of a run, None if it would refuse the scene. ``auto``: ``share``,
        ``num_gaussians`` and ``why`` of ``--budget auto``.
        ``notes``: warnings.

    Raises:
        SceneError: If the ``.ply`` cannot be read, or a named file does not exist. Cameras that are missing or do not
            fit raise no error; the document reports them.

    Example:
        >>> facts = gsmerge.inspect("demo")
        >>> facts["count"], facts["num_views"], facts["camera_format"]
        (7680, 5, 'transforms.json')
    """
    read_hints = make_hints(hints)
    files = find_scene_files(path, cameras=cameras, images=images, masks=masks)
    with use_threads(threads):
        report_progress("inspect: reading", 0, 3)
        ply = read_gaussian_file(files, opacity=opacity, hints=read_hints)
        report_progress("inspect: Gaussians", 1, 3)
        info = ply.info
        opacities = ply.gaussians.opacities[ply.valid]
        opaque = 0.995  # above this opacity, optical depths are capped
        saturated = 1e-6  # float32 changes the logit of an opacity that is nearer to 0 or 1 than this
        described = {
            **{name: getattr(info, name) for name in _FILE_KEYS},
            "marks": list(kept_comments(info)),
            "bytes": info.file_bytes,
            "extents": extents(ply.gaussians[ply.valid] if info.num_nonfinite else ply.gaussians),
            "num_opaque": int((opacities >= opaque).sum()),
            "num_transparent": int((opacities < LEAST_OPACITY).sum()),
            "num_saturated": int(((opacities <= saturated) | (opacities >= 1 - saturated)).sum()),
            "batches": list_batches(files.ply) if files.is_state else [],
        }
        report_progress("inspect: views", 2, 3)
        document: dict[str, Any] = finite(described | _describe_views(ply, files, read_hints))
        document |= note_entries([*document["notes"], *degree_notes(ply.info)])
    return document


def _describe_views(ply: GaussianFile, files: SceneFiles, hints: ReadHints) -> dict[str, Any]:
    """Describe the views of a scene, and whether its rows belong to pixels; see :func:`inspect` for the keys."""
    is_own = is_from_gsmerge(ply.info.comments)
    expected = read_expected_scores(ply.info.comments)
    facts: dict[str, Any] = {
        "cameras": files.cameras and str(files.cameras),
        "images": files.images and str(files.images),
        "exporter": _OWN if is_own else "not known before the cameras fit",
        **note_entries(file_notes(ply.info)),
        **dict.fromkeys(("num_views", "width", "height", "num_missing", "num_sky_views"), 0),
        **dict.fromkeys(_UNKNOWN_KEYS),
        "coverage": [],
        "new_views": None if expected is None else asdict(expected),
        "is_result": RESULT_COMMENT in ply.info.comments,
    }
    load = attempt(finish, find_views(ply, files, hints))
    facts["candidates"] = [asdict(choice) for choice in load.candidates]
    if isinstance(load, SceneError):
        camera_file = None if files.cameras is None else attempt(read_scene_cameras, ply, files)
        if isinstance(camera_file, CameraFile):
            facts |= {"num_views": len(camera_file), "camera_format": camera_file.source}
        return facts | {"alignment_problem": str(load)}
    facts |= {name: (path := getattr(load.files, name)) and str(path) for name in ("cameras", "images")}
    facts |= _describe_scene(load, is_own=is_own)
    if load.recovery is None or load.alignment is None:
        return facts | {"alignment_problem": load.problem}
    return facts | {
        "width": load.scene.cameras.width,
        "height": load.scene.cameras.height,
        "num_missing": 0 if load.scene.covered is None else int((~load.scene.covered).sum()),
        "alignment": asdict(load.alignment),
        "rows": load.recovery.description,
    }


def _describe_scene(load: Loaded, *, is_own: bool) -> dict[str, Any]:
    """Describe a scene that was read: its views, and the result that ``compact`` would make.

    ``is_own`` is True for files of gsmerge, which have no exporter but perhaps unseen Gaussians.
    """
    scene = load.scene
    distinct = without_repeats(scene)[0]  # each view once, as in a run
    # A run takes these steps, too, with these sizes and these notes on sizes and photos
    canonical = distinct
    changes: tuple[str, ...] = ()
    names = ("finite", "frame", "sizes", "pixels", *RULES, "background", "photos")
    with record_part(silent=True) as record:
        if len(distinct.gaussians) > 0:
            # Placing cameras in a scene without any would take as long as the run needs for them
            prepared = take_steps(select(*names) if len(distinct) else select("finite"), begin(distinct))
            canonical = prepared.scene
            changes = prepared.changes
    agreement = confirm_depths(canonical)
    doubt = unlike_captures(canonical.gaussians)
    doubts = doubt and Doubt(doubt), agreement.advice if agreement else None
    notes = [*load.notes, *views_notes(scene), *record.notes, *changes, *doubts]
    facts: dict[str, Any] = {
        **note_entries(list(dict.fromkeys(filter(None, notes)))),
        "num_views": len(scene),
        "camera_format": load.cameras and load.cameras.source,
        "coverage": coverage(scene),
        "compact": estimate(scene, CompactOptions()),
        "agreement": agreement and agreement.to_dict(),
    }
    if agreement is not None:  # otherwise the depths of views cannot be compared
        count = int(agreement.share * distinct.num_gaussians)
        facts["auto"] = {"share": agreement.share, "num_gaussians": count, "why": describe_share(agreement)[1]}
    if len(scene) > 0:
        # How well colours fit the photos, and in how many photos there is sky
        gaussians = scene.gaussians
        images = photo_array(scene.images)
        sight = check_cameras(gaussians, np.ones(len(gaussians), bool), scene.cameras, images)
        means = gaussians.means[np.isfinite(gaussians.means).all(1)]
        facts |= {"sight": asdict(sight), "num_sky_views": len(sky_regions(means, scene.cameras, images))}
    if not is_own:
        is_known = load.recovery is not None or any(exporter.is_marked for exporter in load.exporters)
        titles = join_words(model.title for exporter in load.exporters for model in exporter.models)
        facts["exporter"] = (is_known and titles) or f"not known: {load.info.layout}"
    elif len(scene) > 0 and load.recovery is None:
        # If each pixel had a Gaussian, the number of Gaussians that no view shows would mean nothing, because Gaussians
        # of overlapping views hide each other
        facts["num_unseen"] = int((count_views_in_world(scene.gaussians, scene.cameras) == 0).sum())
    return facts


def inspection_lines(scene: Mapping[str, Any]) -> list[str]:
    """Describe the document of :func:`inspect` in lines of text."""
    attributes = ", ".join(f"{name} {human_bytes(size)}" for name, size in scene["bytes_by_attribute"].items())
    extent = scene["extents"]
    used = _CAMERA_ELEMENTS if scene["cameras"] is None and scene["camera_format"] else ()
    elements = [name for name in scene["extra_elements"] if name not in used]
    ignored = [*scene["extra_columns"], *(f"element {name}" for name in elements)]
    batches = []
    for number, batch in enumerate(scene["batches"], 1):
        count, before, after = (batch.get(name, 0) for name in ("num_views", "num_input", "num_new"))
        names = batch["views"]
        ends = names if len(names) < 2 else [names[0], names[-1]]
        shown = f", {' to '.join(ends)}" if names else ""
        batches.append(f"batch {number:<5}{count} views{shown}; {before:,} -> {after:,} Gaussians")
    is_inside = scene["num_views"] and set(_CAMERA_ELEMENTS) <= set(scene["extra_elements"])
    cameras = scene["cameras"] or ("inside the .ply" if is_inside else "none found")
    cameras += f": {scene['num_views']} ({scene['camera_format']})" if scene["num_views"] else ""
    low, high = (" ".join(f"{value:.4g}" for value in extent[key]) for key in ("box_low", "box_high"))
    lines = [
        f"file       {scene['path']}: {human_bytes(scene['bytes'])} ({attributes})",
        f"layout     {scene['layout']}, {scene['format']}; opacity stored {_ENCODINGS[scene['opacity_encoding']]}",
        f"marks      {'; '.join(scene['marks'])}" if scene["marks"] else "",
        f"exporter   {scene['exporter']}",
        *batches,
        f"ignored    {', '.join(ignored)}" if ignored else "",
        f"Gaussians  {scene['count']:,}: {scene['num_nonfinite']} not finite, {scene['num_empty']:,} empty,"
        f" {scene['num_transparent']:,} transparent,"
        f" {scene['num_opaque']:,} opaque, {scene['num_saturated']:,} of opacity 0 or 1",
        f"extent     {low}  to  {high}  (1 % to 99 %);"
        f" {100 * extent['share_outliers']:.3g} % beyond ten times that box",
        f"floaters   about {round(extent['share_floaters'] * scene['count']):,}: isolated, or beyond that;"
        " compact --drop floaters leaves them out",
        f"unseen     {scene['num_unseen']:,}: hidden or outside all views; --drop unseen leaves them out"
        if scene["num_unseen"]
        else "",
        f"sky        in {scene['num_sky_views']} photos; compact --drop sky leaves it out"
        if scene["num_sky_views"]
        else "",
        f"scales     median {extent['scale_median']:.3g}, largest {extent['scale_max']:.3g} in a scene of"
        f" {extent['diagonal']:.3g}; {100 * extent['share_huge']:.3g} % above a tenth of it",
        f"cameras    {cameras}",
        f"images     {_describe_images(scene)}",
        *_candidate_lines(scene["candidates"]),
        *_alignment_lines(scene),
        *_coverage_lines(scene),
    ]
    if agreement := scene["agreement"]:
        shares = (f"{100 * agreement[key]:.0f} %" for key in ("confirmed", "contradicted", "alone"))
        lines += ["depth      other views confirm {} of the pixels, contradict {}, do not see {}".format(*shares)]
    if new := scene["new_views"]:
        gain = f"{describe_gain(new['low'], new['high'])} against its input"
        lines += [f"new views  {gain}, which shows them at {new['before']:.1f} dB"]
    run = scene["compact"]
    if scene["is_result"]:
        lines += ["compact    not needed: the file is a result of gsmerge; compact its source for another number"]
    else:
        lines += ["compact    would refuse the scene as it is"] if run is None else estimate_lines(run)
    if auto := scene["auto"]:
        share = f"{100 * auto['share']:.3g} %, {auto['num_gaussians']:,} Gaussians"
        lines += [f"auto       --budget auto takes {share}: {auto['why']}"]
    return [line for line in lines if line] + note_lines(scene["notes"])


def _describe_images(scene: Mapping[str, Any]) -> str:
    """Describe where the photos are, and whether they are used."""
    photos = [one for one in scene["candidates"] if one["kind"] == "photos"]
    chosen = next((str(one["path"]) for one in photos if one["chosen"]), None)
    if chosen is None and photos and scene["images"]:
        return f"{scene['images']}, left out"
    return scene["images"] or chosen or "none found"


def _candidate_lines(candidates: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe which cameras, photos and masks may belong to the scene, and why they were chosen or left out."""
    return [f"{'' if i else 'candidates':10} {line}" for i, line in enumerate(candidate_lines(candidates))]


def _alignment_lines(scene: Mapping[str, Any]) -> list[str]:
    """Describe the order of the rows and the distances of Gaussians from their pixels, or say why these are unknown."""
    alignment = scene["alignment"]
    problem = scene["alignment_problem"]
    if problem is not None and scene["compact"] is None:
        return []  # the command ends with this problem as its error
    if problem is not None:
        return [f"alignment  not one Gaussian per pixel: {problem.removeprefix('expected one Gaussian per pixel, ')}"]
    if alignment is None:
        return []
    worst = max(offset for offset in alignment["median_px"] if offset is not None)
    missing = f", none for {scene['num_missing']:,} of them" if scene["num_missing"] else ""
    return [
        f"rows       {scene['rows']}",
        f"alignment  pixels of {scene['num_views']} x {scene['height']} x {scene['width']} (views x height x"
        f" width){missing}; median offset {worst:.2f} px in the worst view,"
        f" {100 * alignment['share_within_1px']:.1f} % within 1 px",
    ]


def _coverage_lines(scene: Mapping[str, Any]) -> list[str]:
    """Describe what share of the pixels or of the Gaussians each view shows, and name the view with the least share."""
    views = scene["coverage"]
    sight = scene["sight"]
    if not views or sight is None:
        return []
    colors = ""
    if sight["color_ratio"] is not None:
        colors = f"; colours {sight['color_ratio']:.2f} times as far from their own pixels as from any others"
    has_pixels = views[0]["share_of_pixels"] is not None
    key, unit = ("share_of_pixels", "pixels") if has_pixels else ("share_of_gaussians", "Gaussians")
    shares = [view[key] for view in views]
    low = f"{100 * min(shares):.0f}"
    high = f"{100 * max(shares):.0f}"
    range_text = f"{high} % of the {unit} in every view"
    if low != high:
        range_text = f"{low} to {high} % of the {unit} per view, least in {views[shares.index(min(shares))]['name']}"
    return [f"coverage   {range_text}; {100 * sight['share_seen']:.0f} % of the Gaussians lie in some picture{colors}"]
