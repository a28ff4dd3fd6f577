"""Sentences of pages that quote a number have the number that the code has today.

Each row is the text of a page, with its numbers taken from the module that defines them. A number that changes in the
code, or in the page, or a sentence that is rewritten, fails here.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from scripts import load_script

import gsmerge
from gsmerge import types
from gsmerge.blocks import compact_blocks as blocks
from gsmerge.blocks import fit_seams as seams
from gsmerge.blocks import partition
from gsmerge.counts import curve
from gsmerge.drawing import render_files as drawings
from gsmerge.drawing.pages import data, splats
from gsmerge.io import bounds, photo_files
from gsmerge.io.formats import ply, units
from gsmerge.method.facts import agreement, scene_size
from gsmerge.method.facts.prepared import LEAST_VIEWS
from gsmerge.method.fit import outside, photo_sizes, schedule, stage
from gsmerge.method.fit import report as fit_report
from gsmerge.method.geometry import views
from gsmerge.method.kernels.raster import blend
from gsmerge.method.networks.checkpoint import IN_PACKAGE
from gsmerge.method.networks.options import RESIDUAL, SLOTS
from gsmerge.method.raster import metrics, photos, tiled_view
from gsmerge.method.stages import fit_pairs, sky
from gsmerge.plan import counts
from gsmerge.plan import fit as fit_plan
from gsmerge.plan.blocks import BLOCK_GAUSSIANS, BLOCK_VIEWS, WHOLE_GAUSSIANS, WHOLE_VIEWS
from gsmerge.plan.efforts import EFFORTS
from gsmerge.plan.make_plan import LONE_K
from gsmerge.prepare import exposure
from gsmerge.prepare import fill_holes as holes
from gsmerge.reading.alignment import align_rows as rows_first
from gsmerge.reading.alignment import score
from gsmerge.reading.alignment import score as cameras_off
from gsmerge.reading.alignment.registration import register
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.reading.held_out import read_held_out
from gsmerge.reading.read_scene import load_scene
from gsmerge.results import new_views, scores
from gsmerge.runtime import memory, work
from gsmerge.scoring import fog
from gsmerge.settings.budget import DEVICES
from gsmerge.settings.compact import RECIPES, method_names
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.fit import FitOptions, Tuning
from gsmerge.settings.stages import MAX_CHILDREN, SHARE, MatchOptions

ROOT = Path(__file__).parents[2]
FIT, RATES, PAPER = FitOptions(), Tuning(), RECIPES["paper"]
DECISIONS, LARGE, NETWORKS = (f"docs/internals/{name}.md" for name in ("decisions", "large-scenes", "networks"))
COMPACT, CONVERT, LOOK, MEASURE, MANY_SCENES, AFTER_A_MODEL = (
    f"docs/guide/{name}.md" for name in ("compact", "convert", "look", "measure", "many-scenes", "after-a-model")
)
CONVENTIONS, EXPORTERS, FORMATS, REPORT = (
    f"docs/reference/{name}.md" for name in ("conventions", "exporters", "formats", "report")
)
NUMBERS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
FRACTIONS = {2: "half", 3: "third", 4: "quarter", 5: "fifth", 10: "tenth", 12: "twelfth"}


def percent(share: float) -> str:
    """Return a share as pages write it."""
    return f"{100 * share:.3g} %"


def part(share: float) -> str:
    """Return a share as a word, such as a quarter."""
    return FRACTIONS[round(1 / share)]


def word(number: int, *, ordinal: bool = False) -> str:
    """Return a small number as a word."""
    return {5: "fifth", 7: "seventh"}[number] if ordinal else NUMBERS[number]


def million(number: int) -> str:
    """Return a number of millions."""
    return f"{number / 1e6:g} million"


def degree(number: int) -> str:
    """Return gigabytes for a million Gaussians with harmonics of a degree."""
    return f"{1e-3 * round((memory.memory_bytes(10**6, num_rest=3 * ((number + 1) ** 2 - 1)) - FIXED) / 1e6):.2f}"


FIXED = memory.memory_bytes(0)
CLAIMS: dict[str, tuple[str, ...]] = {
    DECISIONS: (
        f"A fit that grows starts with at most {percent(stage.START)} of the Gaussians, splits those with the largest"
        f" errors {part(schedule.GROWTH)} way, and averages the last {part(RATES.average_share)} of its steps",
        f"Usually the first {percent(FIT.half_res_part)} of the steps draw a {part(1 / schedule.STRIDE**2)} of the"
        " pixels",
        f"After {percent(RATES.outside_from)} of the steps, every {word(RATES.outside_every, ordinal=True)} step also"
        " draws the scene [from outside]",
        f"a weight that grows from 0 to {RATES.edge_weight:g} over the run",
        f"(every {word(RATES.outside_every, ordinal=True)}, {outside.PLACES} places)",
        f"{fit_pairs.RENDERS_STEP:g} / sqrt(share of Gaussians kept)",
    ),
    LARGE: (
        f"Scenes of more than {million(WHOLE_GAUSSIANS)} Gaussians with pixels are compacted in blocks of views"
        f" (`blocks`): one block for every {million(BLOCK_GAUSSIANS)} Gaussians",
        f"Scenes of more than {WHOLE_VIEWS} views get one block for every {BLOCK_VIEWS} views, if blocks"
        f" cut at most a {part(partition.MOST_CUT)}",
        f"A block also takes views of its neighbours, at most a {part(partition.SHARED)} as many as its own",
        f"A block asks for up to {'twice' if blocks.MOST_DENSITY == 2 else blocks.MOST_DENSITY} as many superpixels",
        f"at {seams.SEAM_RATE:g} times the usual ones, and fall to a tenth",
        f"{word(seams.SEAM_VIEW_STEPS)} for each photo that shows many Gaussians at seams, or"
        f" {word(seams.ROOM_VIEW_STEPS)} if at least {part(seams.ROOM_SHARE)} of all Gaussians are at seams",
        f"The default takes {EFFORTS['default'].steps} steps for up to {fit_plan.USUAL_VIEWS} views",
        f"A block whose process or node was lost is done again, up to {word(work.RETRIES)} times",
        f"| GB per million | {' | '.join(map(degree, range(5)))} |",
    ),
    NETWORKS: (
        f"A correction has {RESIDUAL} columns",
        f"heads for K = {', '.join(map(str, SLOTS))};",
        f"| 0.6 MB, {load_checkpoint(IN_PACKAGE['shipped']).networks.num_parameters:,} parameters"
        f" | 1.0 MB, {load_checkpoint(IN_PACKAGE['paper']).networks.num_parameters:,} parameters |",
    ),
    COMPACT: (
        f"--effort draft`: {EFFORTS['draft'].steps} steps, no merging across views",
        f"--effort fast`: {EFFORTS['fast'].steps} steps",
        f"--effort best`: {EFFORTS['best'].steps} steps",
        f"gsmerge keeps at most {SHARE.replace('%', ' %')} of a scene",
        f"at most what the device draws fluidly: {', '.join(f'{count:,}' for count in DEVICES.values())}",
        f"| `--k` | 1 to {MAX_CHILDREN} | this number for each superpixel; 1 by default, {LONE_K} for a single",
        f"measures quality as PSNR plus {curve.SSIM_DB:g} dB times SSIM",
        f"The useful number of Gaussians is {percent(agreement.MOST_PER_PIXEL)} of the input if other views"
        f" confirm at least {percent(agreement.SOUND_SHARE)} of the depth, and {percent(agreement.FEWEST)} if"
        f" they confirm {percent(agreement.WRONG_SHARE)} or less",
        f"With {word(LEAST_VIEWS)} photos or more, both kinds of `--quality` leave out some views",
        f"The estimate of the gain needs at least {word(LEAST_VIEWS)} photos, a result with at most"
        f" {percent(new_views.MOST_SHARE)} as many Gaussians as pixels",
        f"but at least {SHARE.replace('%', ' %')}, that keep the input's quality",
        f"if it shows the photos at most {counts.FIDELITY_LOSS:g} dB worse than the input does",
        f"at least {counts.FIDELITY_PSNR:g} dB against the input's",
        f"differs at random by more than {percent(exposure.DIFFERENT)}",
        f"at least {photo_sizes.MIN_AUTO_SCALE:g} times as many pixels a side",
        f"wider than a {part(holes.LARGE_SIDE)} of the picture",
        f"cover at least {percent(holes.LARGE_AREA)} of it",
        f"A white pixel counts as {word(int(types.PROTECTED))}",
        f"Scenes of more than {million(WHOLE_GAUSSIANS)} Gaussians",
        f"{part(1 / scores.INPUT_EVERY)} of the input's pixels and {part(1 / scores.RESULT_EVERY)} of the result's in"
        f" {word(views.REPORT_VIEWS)} photos (in drafts: {word(EFFORTS['draft'].report_views)})",
    ),
    CONVERT: (
        f"at the upper border of at least {word(sky.LEAST_SKY_VIEWS)} photos and a {part(sky.LEAST_SKY_SHARE)} of all",
        f"{word(int(sky.FAR_RATIO))} times as far away as the rest",
        f"below 1/{1 / FIT.min_contribution:g} in every picture",
    ),
    MEASURE: (
        f"outside the views start from {word(fog.VIEWS)} input views",
        f"have at most {fog.FOG_PIXELS} pixels on the longer side",
        f"the input's opacity is below {fog.FOG_EMPTY:g} in the whole square of {fog.EROSION_PIXELS} x"
        f" {fog.EROSION_PIXELS} pixels around this pixel",
        f"the mean depth in the result is below {fog.VEIL_SHARE:g} of the input's",
        f"with an opacity above {fog.FOG_SOLID:g} in the input that have an opacity below {fog.FOG_OPEN:g} in the"
        " result",
        f"A long thin Gaussian is at least {word(int(fog.RATIOS[0]))} times as long as its second axis",
        f"it is longer than {percent(fog.LONG)} of the picture's width",
        f"Far fog above {fit_report.HAZE:g} and worst veils above {fog.VEILED:g} are plain to see",
    ),
    MANY_SCENES: (f"the photos of at most {ExtendOptions().max_views} views",),
    LOOK: (
        f"more than {splats.MAX_GAUSSIANS:,} Gaussians",
        f"Of more than {data.MAX_SHOWN_VIEWS} views",
        f"or {' x '.join(map(str, drawings.PLACED_SIZE))} without cameras",
        f"at most {drawings.GIF_SIDE} pixels a side",
        f"a second shows {drawings.FPS:g} frames, or {drawings.GIF_FPS:g} frames of a GIF",
    ),
    AFTER_A_MODEL: (f"Each photo needs {register.MIN_MATCHES} points in common with another one",),
    CONVENTIONS: (
        f"a low-pass adds a variance of {tiled_view.EPS2D:g} square pixels",
        f"larger ones than {blend.MAX_ALPHA:g} are set to {blend.MAX_ALPHA:g}",
        f"a Gaussian window of {metrics.WINDOW} x {metrics.WINDOW} pixels, sigma {metrics.SIGMA:g}",
        f"larger than a {part(scene_size.LARGE_SCALE)} of the scene",
        f"base colours are beyond {scene_size.BRIGHT_COLOR:g}",
        f"logits of opacities (within +-{units.MAX_LOGIT:g})",
    ),
    EXPORTERS: (
        f"is at most {part(rows_first._PLAIN_PX)} a pixel in every view",
        f"in every view is at most {score.MAX_MEDIAN_PX:g} pixels (less in small pictures), and a"
        f" {part(1 / score.SHUFFLED_MARGIN)} of the distance from shuffled pixels",
        f"up to {cameras_off.MAX_PX:g} pixels off (median; {percent(cameras_off.MAX_SHARE)} of the side",
    ),
    FORMATS: (
        f"harmonics of degree 0 to {ply.MAX_READ_DEGREE}",
        f"which is {ply.THIN:g} of the smaller one",
        f"may hold {bounds.MAX_FILES:,} files and folders",
    ),
    REPORT: (
        f"of up to {views.MAX_SCORED_VIEWS} views with `--quality`",
        f"null if it covers {percent(photos.WHOLE_SHARE)} or more",
        f"more than {metrics.MAX_LOSS:g} dB worse than the input does".replace(" 0.", " ."),
        f"less than {metrics.POOR_PSNR:g} dB from its input",
        f"(at most {metrics.MAX_PSNR:g}, for equal pictures)",
        f"`psnr_kept` ({counts.FIDELITY_PSNR:g}) or `loss_kept` ({counts.FIDELITY_LOSS:g})",
    ),
    "SECURITY.md": (
        f"{bounds._FREE_MEMORY / 1e6:g} MB + {bounds._MEMORY_PER_BYTE} x its bytes of memory",
        f"{20e-6 * bounds._FREE_STEPS:g} s + {20 / bounds._BYTES_PER_STEP:g} s per MB of processor time",
        f"64 MB + {photo_files._PHOTO_MEMORY_PER_BYTE} x its bytes",
        f"{photo_files._FREE_PHOTOS / 1e6:g} MB + {photo_files._PHOTOS_PER_BYTE} x their bytes",
    ),
    "docs/results.md": (
        f"Boxes reach to one standard deviation. Boxes match from an IoU of {MatchOptions().iou:g} on, latents from a"
        f" cosine of {MatchOptions().similarity:g} on",
        f"Superpixels are {str(PAPER['superpixels']).replace('%', ' %')} of the pixels before merging",
    ),
}


@cache
def words_of(page: str) -> str:
    """Return the text of a page in one line."""
    return " ".join((ROOT / page).read_text("utf-8").split())


def missing(text: str, quotes: tuple[str, ...]) -> list[str]:
    """Return the quotes that a text does not have; a number goes on no further than in its quote."""
    return [quote for quote in quotes if not re.search(rf"(?<![\d.,]){re.escape(quote)}(?!\d)", text)]


@pytest.mark.parametrize("page", CLAIMS)
def test_numbers_of_pages_are_those_of_the_code(page: str) -> None:
    assert missing(words_of(page), CLAIMS[page]) == []


# Tables of results on the scene of examples/01_make_scene.py: the start of a row, and the settings that make it
TABLES: dict[str, dict[str, dict[str, Any]]] = {
    COMPACT: {
        "defaults": {}, "`--effort draft`": {"effort": "draft"}, "`--effort fast`": {"effort": "fast"},
        "`--effort best`": {"effort": "best"}, "`--fit none`": {"fit": "none"},
    },
    "docs/internals/adding.md": {
        f"`{name}`": {"method": name} | ({} if name.startswith("unmerged") else {"budget": "4.4%"})
        for name in sorted({*method_names()} - {"splat-transform"})
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> tuple[gsmerge.Scene, gsmerge.Views]:
    """Return the scene, and photos that no run has seen."""
    folder = tmp_path_factory.mktemp("example") / "demo"
    load = load_scene(load_script(ROOT / "examples" / "01_make_scene.py").make_scene(folder))
    held_out = read_held_out(load, folder / "targets")
    return load.scene, gsmerge.Views(held_out.cameras, held_out.images, held_out.names)


# A run for each row. The sweeps try what users are told first; runs of 5 to 20 seconds are tried before a release
SWEPT = {(COMPACT, row) for row in ("defaults", "`--effort draft`", "`--effort fast`", "`--fit none`")}


@pytest.mark.parametrize(
    ("page", "row"),
    [
        pytest.param(page, row, marks=pytest.mark.slow if (page, row) in SWEPT else pytest.mark.release)
        for page, rows in TABLES.items()
        for row in rows
    ],
)
def test_tables_of_the_example_are_those_of_today(
    page: str, row: str, example: tuple[gsmerge.Scene, gsmerge.Views]
) -> None:
    """Counts, and PSNR over the pixels that the input views see, as ``gsmerge evaluate`` prints it."""
    scene, held_out = example
    gaussians = gsmerge.compact(scene, **TABLES[page][row]).gaussians
    measured = gsmerge.evaluate(scene, {"": gaussians}, held_out, gsmerge.EvaluateOptions(lpips=(), fog=False))
    quality = measured.results[1].mean("target")[1]
    (line,) = [line for line in (ROOT / page).read_text("utf-8").splitlines() if line.startswith(f"| {row}")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert f"{quality.psnr:.1f} dB" in cells
    assert page.endswith("adding.md") or f"{len(gaussians):,}" in cells
