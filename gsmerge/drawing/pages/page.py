"""Fill the templates of pages; the file of a page contains all that the page shows."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.drawing.pages.data import PageView, ViewData
from gsmerge.frozen import dataclass
from gsmerge.io.formats.rows import describe_gain
from gsmerge.method.facts.pictures import PHOTOS, ROW_COLORS
from gsmerge.runtime.memory import human_bytes, human_share
from gsmerge.types import Cameras
from gsmerge.version import __version__

if TYPE_CHECKING:
    import jinja2

# Content security policy: a page may run only its own scripts and styles, which the policy names by their hashes
PICTURES_POLICY = "default-src 'none'; img-src data:; style-src {style}; script-src {script}"
# The 3D viewer Spark needs WebAssembly and a worker. The viewer's script contains both, as data: and blob: addresses
SOLID_POLICY = f"{PICTURES_POLICY} blob: 'wasm-unsafe-eval'; worker-src data: blob:; connect-src data: blob:"
POLICY_MARK = "{policy}"  # placeholder in the templates until the hashes are known
VIEWER = Path(__file__).parent / "vendor/spark-three.js.gz"
MISSING = "-"  # replaces a missing figure


def view_page(data: ViewData) -> bytes:
    """Make the HTML page of a scene and its results, in UTF-8."""
    has_photos = any(view.photo is not None for view in data.views)
    # What can be chosen for each half of the page: the photos if there are any, the scene itself, each result
    picture = "own colours" if data.reference == ROW_COLORS else "photo"
    sources: list[dict[str, Any]] = [{"name": picture, "splats": None, "count": 0}] if has_photos else []
    for i, side in enumerate(data.sides):
        splats_id = None if side.splats is None else f"splats-{i}"
        drawn_as = {"antialiased": True} if side.antialiased else {}
        sources.append({"name": side.name, "splats": splats_id, "count": side.num_gaussians, **drawn_as})
    right = min(int(has_photos) + 1, len(sources) - 1)  # the first result, with the scene itself to its left
    left = max(right - 1, 0)
    pictures = [(view.photo, *view.stills)[not has_photos :] for view in data.shown]
    stills = [[None if picture is None else data_uri(picture, "image/webp") for picture in row] for row in pictures]
    start_stills = stills[data.start]
    first = {source: start_stills[source] for source in (left, right)}  # shown by the HTML itself, so they appear first
    start_stills[left] = start_stills[right] = None  # the page holds these two stills once

    splats = {f"splats-{i}": base64_text(side.splats) for i, side in enumerate(data.sides) if side.splats is not None}
    result_ids = range(min(len(data.sides) - 1, 1), len(data.sides))  # the results, or the scene if it is alone
    results = [_result_entry(data, i) for i in result_ids]
    by_size = sorted(result_ids, key=lambda i: data.sides[i].num_gaussians)
    own = reference_words(data)[1]
    page = render_template(
        "view.html",
        policy=SOLID_POLICY,
        data=data,
        results=results,
        table=results_table(data),
        own=own,
        sources=sources,
        left=left,
        right=right,
        first=first,
        json_data={
            "sources": sources,
            "photos": has_photos,
            "background": "#808080" if data.cut_out else "#000000",
            "lpips": any(side.mean.lpips_alex is not None for side in data.sides),
            "start": data.start,
            "results": [
                result | {"figures": [[figure.new, figure.mark] for figure in result["figures"]]} for result in results
            ],
            "sizes": [i + has_photos for i in by_size],
            "own": own,
            "views": [_view_entry(view) for view in data.shown],
        },
        stills=stills,
        speed_words=speed_words(results[0]["speed"]),
        agreement=agreement_words(data),
        splats=splats,
        engine=base64_text(VIEWER.read_bytes()) if splats else None,
    )
    return page.encode()


def _result_entry(data: ViewData, side_id: int) -> dict[str, Any]:
    """Return the headline, speed, words and figures of a side, for the template and the page's script."""
    return {
        "headline": _unbroken(headline(data, side_id)),
        "speed": speed(data, side_id),
        "words": size_words(data, side_id),
        "figures": list_figures(data, side_id),
    }


def headline(data: ViewData, side_id: int = 1) -> str:
    """Return the headline of a result: its share of the Gaussians, and its change of quality.

    The headline of a single scene has the number of Gaussians and the quality.
    """
    before = data.sides[0]
    if len(data.sides) == 1:
        quality = before.mean.psnr
        has_quality = quality is not None and np.isfinite(quality)
        return f"{before.num_gaussians:,} Gaussians" + (f", {quality:.1f} dB" if has_quality else "")
    after = data.sides[side_id]
    reference = PHOTOS if data.held_out else data.reference
    old = before.mean.psnr
    new = after.mean.psnr
    share = after.num_gaussians / max(before.num_gaussians, 1)
    share_text = f"{human_share(share, 1 if share >= 0.01 else 2)} of the Gaussians"
    if after.new_views is not None and not data.held_out:
        return f"{share_text}, new views {describe_gain(after.new_views.low, after.new_views.high)}"
    if new is None or old is None or not np.isfinite(new):
        return share_text
    if not np.isfinite(old):  # the input itself is the reference
        return f"{share_text}, {new:.1f} dB from the input's own renders"
    target = "its own photos" if reference == PHOTOS else reference
    if data.held_out:
        target = "photos that were not used"
    return f"{share_text}, {abs(new - old):.1f} dB {'closer to' if new >= old else 'farther from'} {target}"


def agreement_words(data: ViewData) -> str:
    """Say how much of the depth other views confirm or, if it is little, what would raise this share."""
    if data.agreement is None:
        return ""
    return data.agreement.advice or f"{100 * data.agreement.confirmed:.0f} % of the depth is confirmed by other views"


def speed(data: ViewData, side_id: int = 1) -> float | None:
    """Return how many times faster a result is drawn than the scene on this processor, or None for a single scene."""
    if len(data.sides) == 1 or not data.sides[side_id].seconds:
        return None
    return round(data.sides[0].seconds / data.sides[side_id].seconds, 2)


def speed_words(ratio: float | None) -> str:
    """Return the end of the headline, which says how much faster a result is drawn.

    Returns "" if the result is not clearly faster.
    """
    min_ratio = 1.2  # the headline mentions a ratio of drawing times from this value on
    if ratio is None or ratio < min_ratio:
        return ""
    times = f"about {float(f'{ratio:.1g}'):.0f}" if ratio >= 3 else f"{ratio:.1f}"  # one digit from 3 on
    return f", {times}\u00a0\u00d7\u00a0faster to draw"


def size_words(data: ViewData, side_id: int) -> str:
    """Return a side's share of the scene's Gaussians, its bytes and its PSNR, for the list of sizes to choose from."""
    side = data.sides[side_id]
    share = human_share(side.num_gaussians / max(data.sides[0].num_gaussians, 1), 1)
    quality = _format_number(side.mean.psnr, 1)
    words = [share, human_bytes(side.file_bytes), *([f"{quality} dB"] if quality != MISSING else [])]
    return _unbroken(" · ".join(words))


@dataclass(frozen=True)
class Figure:
    """A figure at the top of the page, for the scene itself and for a result."""

    label: str
    old: str  # value of the scene itself
    new: str  # value of the result
    mark: str  # CSS class: "up" if better than the scene, "own" if the figure is over photos of the fit, otherwise ""


def list_figures(data: ViewData, side_id: int) -> list[Figure]:
    """List the figures at the top of the page for one side: its size, expected gain, and mean quality."""
    before = data.sides[0]
    after = data.sides[side_id]
    figures = [
        Figure("Gaussians", f"{before.num_gaussians:,}", f"{after.num_gaussians:,}", ""),
        Figure("File", human_bytes(before.file_bytes), human_bytes(after.file_bytes), ""),
    ]
    views, own = reference_words(data)
    is_expected = not data.held_out and any(side.new_views is not None for side in data.sides)
    names = ("psnr",) if is_expected else ("psnr", "ssim")  # the expected gain takes the room of the SSIM
    qualities = [(f"{name.upper()}, {views}", name, before.mean, after.mean) for name in names]
    if data.lacks_pixels:
        label = f"PSNR on the {100 * (before.covered_share or 0):.0f} % that have Gaussians"
        qualities.append((label, "psnr", before.covered, after.covered))
    scores = []
    for label, name, old_quality, new_quality in qualities:
        if any(getattr(side.mean, name) is not None for side in data.sides[1:] or data.sides):
            old = getattr(old_quality, name)
            new = getattr(new_quality, name)
            digits, unit = (2, " dB") if name == "psnr" else (3, "")
            is_better = side_id > 0 and old is not None and new is not None and old < new
            mark = "up" if is_better else ""
            if own:
                mark = "own"
            scores.append(Figure(label, _format_number(old, digits), _format_number(new, digits) + unit, mark))
    if is_expected:
        expected = after.new_views
        words = MISSING if expected is None else describe_gain(expected.low, expected.high)
        figures.append(Figure("New views", "", words, "up" if expected is not None and expected.gain > 0 else ""))
    return figures + (scores if data.scored else [])


def reference_words(data: ViewData) -> tuple[str, bool]:
    """Return words for the pictures behind the scores, and True if a fit may have used these pictures."""
    if data.held_out:
        return "held-out photos", False
    return ("its own photos", True) if data.reference == PHOTOS else (data.reference, False)


def results_table(data: ViewData) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of the table of all results, without columns that have no figure."""
    first = data.sides[0]
    columns: dict[str, list[str]] = {
        "": [side.name for side in data.sides],
        "File": [human_bytes(side.file_bytes) for side in data.sides],
    }
    for head, name, digits in (("PSNR (dB)", "psnr", 2), ("SSIM", "ssim", 3), ("LPIPS", "lpips_alex", 3)):
        columns[head] = [_format_number(getattr(side.mean, name), digits) for side in data.sides]
    columns["Gaussians"] = [f"{side.num_gaussians:,}" for side in data.sides]
    columns["Share"] = [human_share(side.num_gaussians / max(first.num_gaussians, 1), 1) for side in data.sides]
    if data.lacks_pixels:
        columns["PSNR, covered"] = [_format_number(side.covered.psnr, 2) for side in data.sides]
    filled = {head: cells for head, cells in columns.items() if set(cells) != {MISSING}}
    return list(filled), [list(row) for row in zip(*filled.values(), strict=True)]


def _unbroken(text: str) -> str:
    """Prevent line breaks between numbers and their units."""
    return text.replace(" dB", "\u00a0dB").replace(" %", "\u00a0%")


def _format_number(value: float | None, digits: int) -> str:
    """Format a number; a missing number and the infinite PSNR of equal pictures become ``MISSING``."""
    return MISSING if value is None or value == float("inf") else f"{value:.{digits}f}"


def _view_entry(view: PageView) -> dict[str, Any]:
    """Convert a view to JSON types for the page's script."""
    return {
        "name": view.name,
        "held_out": view.held_out,
        "outside": view.outside,
        **page_camera(view.camera, view.distance),
        "scores": [
            [_round_finite(score.psnr), _round_finite(score.ssim), _round_finite(score.lpips_alex)]
            for score in view.scores
        ],
    }


def page_camera(camera: Cameras, distance: float) -> dict[str, Any]:
    """Convert a camera to JSON types for a page's script; ``distance`` is how far away the scene is from the camera."""
    return {
        "viewmat": camera.viewmats[0].reshape(-1).tolist(),
        "K": [float(camera.Ks[0, row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))],
        "width": camera.width,
        "height": camera.height,
        "distance": distance,
    }


def _round_finite(value: float | None) -> float | None:
    """Round a number for JSON; the infinite PSNR of equal pictures becomes None."""
    return None if value is None or value == float("inf") else round(value, 4)


def data_uri(content: bytes, kind: str) -> str:
    """Encode content of the media type ``kind`` as a ``data:`` address."""
    return f"data:{kind};base64,{base64_text(content)}"


def base64_text(content: bytes) -> str:
    """Encode bytes in base64."""
    return base64.b64encode(content).decode("ascii")


def render_template(name: str, policy: str, **values: Any) -> str:
    """Fill the template file ``name`` with values, which are escaped unless the template says otherwise.

    ``policy`` is the page's content security policy. The policy's ``{script}`` and ``{style}`` become the hashes of the
    page's scripts and styles.
    """
    text = _environment().get_template(name).render(version=__version__, **values)
    text = text.encode("utf-8", "replace").decode("utf-8")  # names of files may have lone surrogates
    hashes = {}
    for kind in ("script", "style"):
        # Elements with a type attribute hold data, which a browser does not run
        contents = re.findall(f"<{kind}>(.*?)</{kind}>", text, re.DOTALL)
        digests = dict.fromkeys(hashlib.sha256(content.encode()).digest() for content in contents)
        hashes[kind] = " ".join(f"'sha256-{base64_text(digest)}'" for digest in digests)
    return text.replace(POLICY_MARK, html.escape(policy.format(**hashes)), 1)


@cache
def _environment() -> jinja2.Environment:
    """Make the environment of all templates."""
    import jinja2

    loader = jinja2.PackageLoader("gsmerge.drawing.pages")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"bytes": human_bytes, "number": _format_number}
    dumps = partial(json.dumps, separators=(",", ":"), allow_nan=False)
    environment.policies["json.dumps_function"] = lambda value, **_: dumps(value)
    return environment
