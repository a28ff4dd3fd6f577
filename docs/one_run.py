"""Write the part of docs/internals/architecture.md, and its picture, that follow a small scene through a run.

python docs/one_run.py          # write the page and the picture if they differ from the program
python docs/one_run.py --check  # only name the files that differ; the exit code is 1 if there are any

The script records what functions of the package return while `gsmerge.compact` works, so all values are those of a real
run. The prose of this part is here, and all other text of the page is written by hand. A sentence that may become
untrue goes through :func:`say` with its condition. If the condition does not hold, the script stops and names the
sentence.
"""

from __future__ import annotations

import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from skimage.segmentation import find_boundaries

import gsmerge
from gsmerge.method.geometry.transforms import IDENTITY, covariances, project
from gsmerge.method.pipelines.pixel_rows import PIXEL_ROWS
from gsmerge.research.generate import GenerateOptions, NoiseOptions, generate_scene

DOCS = Path(__file__).parent
PAGE, PICTURE = DOCS / "internals" / "architecture.md", DOCS / "images" / "one-run.jpg"
# Comments before and after the part of the page that is made here
START, END = "<!-- one run: made by docs/one_run.py from a run; change the text there -->\n", "\n<!-- end -->"
VIEWS, WIDTH, HEIGHT, SEED = 4, 96, 64, 2
VIEW, X, Y = 1, 38, 28  # the pixel that the page follows
ROW = (VIEW * HEIGHT + Y) * WIDTH + X  # row of this pixel's Gaussian
LINE = 120  # most characters of a line of the page
DIAGONAL = ([0, 1, 2], [0, 1, 2])  # indices of the diagonal of a matrix [3,3]
WATCHED = {  # functions that are recorded, by the module that calls them
    "gsmerge.reading.make_scene": ("find_pixels",),
    "gsmerge.run": ("make_plan", "build", "make_result"),
    "gsmerge.method.pipelines.pixel_rows": ("segment_scene", "correct", "match", "merge", "decode_merged", "fit_scene"),
}
ZOOM, STRIP, GAP = 4, 22, 6  # enlargement of photos, height of a title, and gap between panels, pixels
DARK, BORDER = 0.45, (255, 255, 255)  # brightness of the photo under ellipses, and RGB colour of superpixel borders
ALONE, SEVERAL, FOLLOWED = (255, 210, 60), (90, 230, 255), (255, 70, 200)  # RGB colours of ellipses
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 85]
SAME = 1.0  # largest mean difference, of 255, between pictures that versions of OpenCV draw


class UntrueError(Exception):
    """A sentence of this script is not true for the run."""


def main() -> int:
    """Write the page and the picture if they are stale, or only name them with ``--check``; return the exit code."""
    check = "--check" in sys.argv[1:]
    try:
        run = watch_run()
        page, picture = make_page(run), draw_picture(run)
    except UntrueError as error:
        print(f"docs/one_run.py: no longer true, rewrite it: {error}")
        return 1
    stale = []
    if PAGE.read_text(encoding="utf-8") != page:
        stale.append(PAGE)
        if not check:
            PAGE.write_text(page, encoding="utf-8")
    if not is_same(picture):
        stale.append(PICTURE)
        if not check:
            PICTURE.write_bytes(picture)
    for path in stale:
        print(path.relative_to(DOCS.parent))
    return 1 if stale and check else 0


def is_same(picture: bytes) -> bool:
    """Return whether the stored picture shows the same as this one, apart from titles and small differences.

    Versions of OpenCV draw letters and ellipses differently.
    """
    if not PICTURE.is_file():
        return False
    new, stored = (cv2.imdecode(np.frombuffer(data, np.uint8), 1) for data in (picture, PICTURE.read_bytes()))
    if stored is None or stored.shape != new.shape:
        return False
    is_panel = np.arange(GAP, len(new) + GAP) % (STRIP + GAP + HEIGHT * ZOOM) >= STRIP + GAP  # of each row of pixels
    return float(np.abs(stored.astype(float) - new)[is_panel].mean()) < SAME


# The run


@dataclass(frozen=True)
class Run:
    """The record of a run."""

    arguments: dict[str, tuple[Any, ...]]  # of the first call of each watched function, by its name
    made: dict[str, Any]  # results of these calls
    result: gsmerge.CompactResult

    @property
    def prepared(self) -> Any:
        """The prepared scene, which `make_plan` gets."""
        return self.arguments["make_plan"][0]

    @property
    def label(self) -> int:
        """Number of the superpixel of the pixel that the page follows."""
        return int(self.made["segment_scene"].groups.labels[VIEW, Y, X])

    @property
    def feature(self) -> int:
        """Row of the Feature Gaussian of that pixel."""
        return find_holder(self.made["correct"])

    @property
    def merged(self) -> int:
        """Row of the Feature Gaussian that has that pixel after merging across views."""
        return find_holder(self.made["merge"])

    @property
    def fitted(self) -> np.ndarray:
        """Rows of the fitted Gaussians that come from the merged Feature Gaussian."""
        return np.flatnonzero(self.made["fit_scene"].report.origins == self.merged)

    @property
    def written(self) -> int:
        """Row in the result of the first of the fitted Gaussians that the result has."""
        means = self.made["fit_scene"].gaussians.means[self.fitted]
        of_result = [mean.tobytes() for mean in self.made["build"].gaussians.means]
        return next(of_result.index(mean.tobytes()) for mean in means if mean.tobytes() in of_result)


def find_holder(features: Any) -> int:
    """Return the row of the Feature Gaussian that has the followed Gaussian as a member."""
    at = int(np.flatnonzero(features.members == ROW)[0])
    return int(np.searchsorted(features.starts, at, side="right")) - 1


def watch_run() -> Run:
    """Make the scene, compact it with the defaults, and return the record of the run."""
    arguments: dict[str, tuple[Any, ...]] = {}
    made: dict[str, Any] = {}

    def watch(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that also records its first call."""

        def call(*args: Any, **kwargs: Any) -> Any:
            """Call the function, and keep the arguments and the result of its first call."""
            result = function(*args, **kwargs)
            if name not in made:  # later calls belong to the trial that estimates new views
                arguments[name], made[name] = args, result
            return result

        return call

    with ExitStack() as stack:
        folder = stack.enter_context(temporary_scene())
        for module, names in WATCHED.items():
            for name in names:
                place = import_module(module)
                stack.enter_context(mock.patch.object(place, name, watch(name, getattr(place, name))))
        result = gsmerge.compact(folder)
    return Run(arguments, made, result)


@contextmanager
def temporary_scene() -> Iterator[Path]:
    """Write the scene into a temporary folder, which is removed at the end."""
    export = NoiseOptions(sh_degrees=(0,), constant_opacity=0.0, unit=(1.0, 1.0))  # a usual export, in metres
    options = GenerateOptions(views=VIEWS, width=WIDTH, height=HEIGHT, ranges=export)
    with tempfile.TemporaryDirectory() as folder:
        yield generate_scene(Path(folder) / "scene", options, seed=SEED)


# The page


def say(sentence: str, holds: bool) -> str:
    """Return a sentence if its condition holds; raise UntrueError otherwise."""
    if not holds:
        raise UntrueError(sentence)
    return sentence


def text(*sentences: str, indent: str = "") -> str:
    """Join sentences or parts of sentences to a paragraph, in lines of the page's length."""
    return textwrap.fill(
        " ".join(sentences), LINE, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def step(name: str, *sentences: str) -> str:
    """Join the sentences of a step after its name."""
    return " ".join([f"**{name}.**", *sentences])


def entry(function: str, name: str, values: np.ndarray, row: Any, digits: int = 2) -> str:
    """Return a row of the table: a function, an array with its shape, and one row of the array."""
    shown = np.asarray(values[row])
    is_real = np.issubdtype(shown.dtype, np.floating)
    cells = [f"{round(float(cell), digits) + 0.0:.{digits}f}" if is_real else f"{cell}" for cell in shown.flat]
    return f"| `{function}` | `{name}` [{', '.join(map(str, values.shape))}] | {', '.join(cells)} |"


def make_page(run: Run) -> str:
    """Return the text of the page with a new block, between START and END."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
    _, found, after = rest.partition(END)
    if not found:
        raise ValueError(f"{PAGE.name}: expected {START.strip()} and {END.strip()}")
    return f"{before}{START}\n{make_block(run)}{END}{after}"


def make_block(run: Run) -> str:
    """Return the block of the page that follows the run: the picture, a table of values, and a list of the steps."""
    steps = [*first_steps(run), *build_steps(run), result_step(run)]
    items = [text(f"{number}. {words}", indent="   ") for number, words in enumerate(steps, 1)]
    return "\n\n".join([*head(run), values_table(run), "\n".join(items)]) + "\n"


def head(run: Run) -> list[str]:
    """Write the beginning of the block: which scene is compacted, and what the picture and the table show."""
    return [
        text(
            f"This scene has {VIEWS} photos of {WIDTH} x {HEIGHT} pixels of a room, their cameras, and",
            f"{run.prepared.input_scene.num_gaussians:,} Gaussians, one for each pixel, with the errors of a predicted",
            "depth ([`generate`](networks.md#generate) made it). The picture shows one view at each step. Ellipses are",
            "contours of Gaussians at one standard deviation: yellow for this view alone, blue for several views, and",
            "pink for the Gaussian of the table.",
        ),
        f"![One view: photo, superpixels, Feature Gaussians, merged, fitted, result](../images/{PICTURE.name})",
        text(
            f"The table has the row of each array that belongs to pixel ({X}, {Y}) of view {VIEW}, or to what became",
            "of it.",
        ),
    ]


def values_table(run: Run) -> str:
    """Write the table of arrays, in the order of the steps."""
    made, prepared, ply = run.made, run.prepared, run.arguments["find_pixels"][0]
    features, merged, fitted = made["correct"], made["merge"], made["fit_scene"]
    return "\n".join([
        "| function | array | row |",
        "|---|---|---|",
        entry("find_pixels", "ply.gaussians.means", ply.gaussians.means, ROW),
        entry("prepare", "scene.gaussians.means", prepared.scene.gaussians.means, ROW),
        entry("segment_scene", "groups.labels", made["segment_scene"].groups.labels, (VIEW, Y, X)),
        entry("correct", "features.covars", features.covars, (run.feature, *DIAGONAL), 4)[:-2] + " (diagonal) |",
        entry("merge", "features.means", merged.means, run.merged),
        entry("fit_scene", "gaussians.scales", fitted.gaussians.scales, run.fitted[0], 4),
        entry("make_result", "gaussians.means", run.result.gaussians.means, run.written),
    ])  # fmt: skip


def first_steps(run: Run) -> list[str]:
    """Write the steps before anything is built: the scene is read and prepared, and the run is planned."""
    prepared, plan, made = run.prepared, run.made["make_plan"], run.made["find_pixels"]
    pixels, limits, recovery = WIDTH * HEIGHT, plan.count.limits, made.recovery
    first = int(limits.per_view * plan.merge.superpixels.start_share)
    scene = prepared.input_scene
    own = scene.has_own_pixels and scene.pixels.shown.all() and int(scene.pixels.fronts[VIEW, Y, X]) == ROW
    return [
        step(
            "Read",
            "`find_pixels` assumes an order of the rows, and measures how far Gaussians lie from their pixels. For",
            say(
                f'"{recovery.layout.description}" the median distance is {recovery.alignment.middle_px:.2f} pixels,',
                recovery.layout.ids is None and recovery.frame is IDENTITY,
            ),
            say(
                f"so row {ROW} is pixel ({VIEW} · {HEIGHT} + {Y}) · {WIDTH} + {X}, and each view has Gaussians of its"
                " own.",
                int(made.pixel_ids[ROW]) == ROW and bool(own),
            ),
        ),
        step(
            "Prepare",
            say(
                "The photos show what the Gaussians show, so the fit and all scores refer to them.",
                prepared.reference.name == "photos" and prepared.reference.score_views == tuple(range(VIEWS)),
            ),
            f"Other views confirm the depth of {100 * prepared.agreement.confirmed:.0f} % of the pixels.",
            say("The photos agree with each other, so no camera or exposure is changed.",
                not prepared.moved and prepared.reference.photo_files is None),
        ),
        step(
            "Plan",
            say(
                "No option limits the number of Gaussians, and every Gaussian belongs to a pixel, so `make_plan` allows"
                f" {plan.settings['superpixels']} of the {pixels:,} pixels of each view, {limits.default:,} in all.",
                limits.exact is None and not plan.count.keeps_fidelity and plan.count.target_psnr is None,
            ),
            say(
                f"The fit starts with only {first} superpixels of each view, because it adds Gaussians itself where"
                " renders differ most from the photos.",
                plan.fit.grows and plan.pipeline == PIXEL_ROWS,
            ),
            say(
                "Networks are not used, because a fit to photos gains more.",
                plan.merge.checkpoint is None and prepared.reference.of_views,
            ),
        ),
    ]  # fmt: skip


def build_steps(run: Run) -> list[str]:
    """Write the steps that build the Gaussians, the stages of the pipeline."""
    made, at = run.made, run.feature
    features, matches = made["correct"], made["match"]
    merged, decoded, fitted = made["merge"], made["decode_merged"], made["fit_scene"]
    plan, report, written = made["make_plan"], made["fit_scene"].report, made["build"].gaussians
    own = np.flatnonzero(matches.clusters == matches.clusters[at])
    faint = int((features.gains < 1).sum())
    before, after = ({mean.tobytes() for mean in some.means} for some in (fitted.gaussians, written))
    return [
        step(
            "Superpixels",
            "Superpixels follow borders of colours, because a Gaussian has one colour.",
            f"The pixel lies in superpixel {run.label}, which has {int(np.diff(features.starts)[at])} pixels.",
        ),
        step(
            "Encode",
            "A Feature Gaussian has the mean and the covariance of the superpixel's Gaussians, weighted by their",
            say(
                f"opacities. `correct` makes {faint} of the {len(features)} Feature Gaussians fainter,"
                " because more views see through them than confirm their depth.",
                plan.merge.weakens and faint > 0,
            ),
        ),
        step(
            "Match and merge",
            "Feature Gaussians of different views match if they overlap and have similar colours. The pixel's cluster",
            say(
                "has one of each of the views"
                f" {', '.join(map(str, features.views[own][:-1]))} and {features.views[own][-1]}.",
                len({*features.views[own]}) == len(own) > 1 and plan.merge.match.match == "overlap",
            ),
            f"`merge` makes {len(merged)} of the {len(features)} Feature Gaussians, one for each cluster.",
        ),
        step(
            "Decode",
            f"Each of the {len(merged)} becomes one Gaussian,",
            say("because K is 1.", plan.merge.decode.k == 1 and len(decoded.gaussians) == len(merged)),
        ),
        step(
            "Fit",
            f"Half way the fit splits the Gaussians with the largest errors. It ends with {len(fitted.gaussians):,},",
            f"{len(run.fitted)} of which come from the pixel's Gaussian. On patches of the photos that the first steps",
            "leave out, the PSNR rises from",
            say(
                f"{report.holdout_before:.1f} to {report.holdout_after:.1f} dB, so the fit is accepted.",
                report.accepted and report.method == "full",
            ),
        ),
        step(
            "Prune and fill",
            f"{len(before - after)} Gaussians change no photo by more than rounding does, and are dropped. Cameras",
            say("between the photos see no empty places, so nothing is filled.", not after - before),
        ),
    ]  # fmt: skip


def result_step(run: Run) -> str:
    """Write the step that makes the result, with its quality."""
    report = run.result.report
    return step(
        "Result",
        f"{len(run.result.gaussians):,} Gaussians replace {run.prepared.input_scene.num_gaussians:,}. The PSNR of the",
        say(
            f"photos rises from {report.psnr_before:.1f} to {report.psnr_after:.1f} dB, because the input has wrong"
            " depths.",
            report.psnr_after > report.psnr_before,
        ),
        "The fit has seen these photos, so a trial leaves photos out, and estimates that new views gain",
        say(f"about {report.new_views.gain:.1f} dB.", report.worse is None and report.new_views.low > 0),
    )


# The picture


def draw_picture(run: Run) -> bytes:
    """Draw six panels of one view as a JPEG: photo, superpixels, Feature Gaussians, merged, fitted, result."""
    prepared, features, merged = run.prepared, run.made["correct"], run.made["merge"]
    photo, labels = enlarge(prepared.scene.images[VIEW]), enlarge(run.made["segment_scene"].groups.labels[VIEW])
    dark = to_bytes(DARK * photo)
    cut = to_bytes(photo)
    cut[find_boundaries(labels, mode="inner")] = BORDER
    cut[(labels == run.label) & find_boundaries(labels == run.label, mode="inner")] = FOLLOWED
    spot = to_bytes(photo)
    cv2.rectangle(spot, (X * ZOOM - 1, Y * ZOOM - 1), ((X + 1) * ZOOM, (Y + 1) * ZOOM), FOLLOWED, 1)
    fitted, cameras = run.made["fit_scene"], prepared.scene.cameras[[VIEW]]
    own, kept = np.flatnonzero(features.views == VIEW), np.flatnonzero(has_members(merged))
    children = np.flatnonzero(np.isin(fitted.report.origins, kept))
    origins, after = fitted.report.origins[children], fitted.gaussians[children]
    spread = covariances(after.quats.astype(float), after.scales.astype(float))
    yellow = np.zeros(len(own), bool)
    panels = [
        ("photo", spot),
        (f"{len(np.unique(labels))} superpixels", cut),
        (
            f"{len(own)} Feature Gaussians",
            draw_ellipses(dark, features.means[own], features.covars[own], cameras, own == run.feature, yellow),
        ),
        (
            f"{len(kept)} merged across views",
            draw_ellipses(
                dark, merged.means[kept], merged.covars[kept], cameras, kept == run.merged, merged.views[kept] < 0
            ),
        ),
        (
            f"{len(children)} fitted",
            draw_ellipses(dark, after.means, spread, cameras, origins == run.merged, merged.views[origins] < 0),
        ),
        ("result, from all Gaussians", to_bytes(enlarge(gsmerge.render(fitted.gaussians, cameras).images[0]))),
    ]
    titled = [add_title(f"{number} {title}", panel) for number, (title, panel) in enumerate(panels, 1)]
    rows = [np.concatenate(titled[first : first + 3], 1) for first in (0, 3)]
    whole = np.concatenate(rows)[GAP:, GAP:]
    return bytes(cv2.imencode(".jpg", whole[..., ::-1], JPEG)[1])


def has_members(features: Any) -> np.ndarray:
    """Return a mask ``[g]``: True for Feature Gaussians that have a pixel of the view among their members."""
    of_view = features.members // (WIDTH * HEIGHT) == VIEW
    return np.logical_or.reduceat(of_view, features.starts[:-1])


def enlarge(image: np.ndarray) -> np.ndarray:
    """Enlarge an image to the size of a panel."""
    return image.repeat(ZOOM, 0).repeat(ZOOM, 1)


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image in [0, 1] to uint8."""
    return np.ascontiguousarray(np.round(image.clip(0, 1) * 255).astype(np.uint8))


def draw_ellipses(
    picture: np.ndarray, means: np.ndarray, covars: np.ndarray, cameras: Any, followed: np.ndarray, shared: np.ndarray
) -> np.ndarray:
    """Draw the contours of Gaussians at one standard deviation, far ones first.

    ``followed [g]`` is True for Gaussians of the followed pixel, which are drawn last, and ``shared [g]`` for Gaussians
    of several views.
    """
    picture, rotation, K = picture.copy(), cameras.viewmats[0, :3, :3].astype(float), cameras.Ks[0].astype(float)
    (places,), (depths,) = project(means, cameras)
    for i in np.lexsort((-depths, followed)).tolist():
        slope_x, slope_y = (places[i] - K[:2, 2]) / (K[0, 0], K[1, 1])  # of the ray
        jacobian = np.array([[K[0, 0], 0, -K[0, 0] * slope_x], [0, K[1, 1], -K[1, 1] * slope_y]]) / depths[i]
        projected = jacobian @ rotation @ covars[i].astype(float) @ rotation.T @ jacobian.T
        variances, axes = np.linalg.eigh(projected)
        angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))  # of the longer axis
        sides = np.sqrt(variances[::-1].clip(0)) * ZOOM
        numbers = (np.round(16 * values).astype(int).tolist() for values in (places[i] * ZOOM - 0.5, sides))
        color = FOLLOWED if followed[i] else SEVERAL if shared[i] else ALONE
        cv2.ellipse(picture, *numbers, angle, 0, 360, color, 1, cv2.LINE_AA, 4)  # numbers are sixteenths of a pixel
    return picture


def add_title(title: str, panel: np.ndarray) -> np.ndarray:
    """Put a title above a panel, and a white border around both."""
    framed = np.pad(panel, ((STRIP + GAP, 0), (GAP, 0), (0, 0)), constant_values=255)
    cv2.putText(framed, title, (GAP, STRIP), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return framed


if __name__ == "__main__":
    sys.exit(main())
