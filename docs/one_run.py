"""Write docs/internals/one-run.md and its picture, which follow a small scene step by step through a run.

python docs/one_run.py          # write the page and the picture if they differ from the program
python docs/one_run.py --check  # only name the files that differ; the exit code is 1 if there are any

The script records what functions of the package return while `gsmerge.compact` works, so all values are those of a real
run. Each section of the page has its function, with its prose and its values. A sentence that may become untrue goes
through :func:`say` with its condition. If the condition does not hold, the script stops and names the sentence.
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
from gsmerge.geometry.transforms import IDENTITY, covariances, project
from gsmerge.research.generate import GenerateOptions, NoiseOptions, generate_scene

DOCS = Path(__file__).parent
PAGE, PICTURE = DOCS / "internals" / "one-run.md", DOCS / "images" / "one-run.jpg"
NOTICE = "<!-- Made by docs/one_run.py from a run: change the text there and run it again. -->"
VIEWS, WIDTH, HEIGHT, SEED = 4, 96, 64, 2
VIEW, X, Y = 1, 38, 28  # the pixel that the page follows
ROW = (VIEW * HEIGHT + Y) * WIDTH + X  # row of this pixel's Gaussian
LINE = 120  # most characters of a line of the page
WATCHED = {  # functions that are recorded, by the module that calls them
    "gsmerge.reading.read_scene": ("align",),
    "gsmerge.road": ("make_plan", "build", "make_result"),
    "gsmerge.pipeline": ("segment_scene", "correct", "match", "merge", "decode_merged", "fit_scene"),
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
    if not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != page:
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


def text(*sentences: str) -> str:
    """Join sentences or parts of sentences to a paragraph, in lines of the page's length."""
    return textwrap.fill(" ".join(sentences), LINE, break_long_words=False, break_on_hyphens=False)


def entry(name: str, values: Any, row: Any = None, digits: int = 2) -> str:
    """Return a line for an array, with its shape, its type and the values of one row; or for another value."""
    if not isinstance(values, np.ndarray):
        return f"- `{name}`: {values}"
    shape = ", ".join(map(str, values.shape))
    shown = np.asarray(values if row is None else values[row])
    is_real = np.issubdtype(shown.dtype, np.floating)
    cells = [f"{round(float(cell), digits) + 0.0:.{digits}f}" if is_real else f"{cell}" for cell in shown.flat]
    return f"- `{name}` [{shape}] {values.dtype}: {', '.join(cells)}"


def make_page(run: Run) -> str:
    """Return the text of the page."""
    sections = (head, align_section, prepare_section, plan_section, build_section, result_section)
    return "\n\n".join(section(run) for section in sections) + "\n"


def head(run: Run) -> str:
    """Write the beginning of the page: which scene is compacted, and what the picture shows."""
    count = run.prepared.input_scene.num_gaussians
    return "\n\n".join([
        f"{NOTICE}\n\n# One run",
        text(
            f"This page says what each step of `gsmerge.compact(folder)` makes of a scene of {count:,} Gaussians.",
            "The [generator](lab.md) makes the scene:",
            f"{VIEWS} photos of {WIDTH} x {HEIGHT} pixels of a room, their cameras, and a `scene.ply` with one",
            "Gaussian per pixel, with the errors of a predicted depth.",
            "[Conventions](../reference/conventions.md) explain names and words.",
        ),
        text(
            "Lists give arrays with shape and type, and the values of one row of each array.",
            f"This row belongs to pixel ({X}, {Y}) of view {VIEW}, or to what became of this pixel.",
        ),
        f"![One view: photo, superpixels, Feature Gaussians, merged, fitted, result](../images/{PICTURE.name})",
        text(
            f"All panels show view {VIEW}. Ellipses are contours of Gaussians at one standard deviation: yellow for",
            "Gaussians of this view alone, blue for several views, pink for what became of the pixel.",
        ),
    ])  # fmt: skip


def align_section(run: Run) -> str:
    """Write the section on which row is which pixel."""
    ply, camera_file = run.arguments["align"][:2]
    made = run.made["align"]
    recovery = made.recovery
    return "\n\n".join([
        "## 1. align: which row is which pixel",
        text(
            "[`align_rows.py`](../../gsmerge/reading/alignment/align_rows.py) gets rows, cameras and photos,",
            "and returns the pixel of every row if the rows show it.",
        ),
        "\n".join([
            entry("ply.gaussians.means", ply.gaussians.means, ROW),
            entry("ply.gaussians.opacities", ply.gaussians.opacities, ROW),
            entry("camera_file.viewmats", camera_file.viewmats, (VIEW, slice(3), 3)) + " (column 3 of view 1)",
            entry("result.pixel_ids", made.pixel_ids, ROW),
        ]),
        text(
            "A `.ply` does not say which pixel a row belongs to. `align` assumes an order, projects Gaussians into the",
            "cameras of their pixels, and measures their distance from the pixels' centres.",
            say(
                f'Here the first reading, "{recovery.layout.description}", decides: the median distance is',
                recovery.layout.ids is None and recovery.frame is IDENTITY,
            ),
            f"{recovery.alignment.middle_px:.2f} pixels.",
            say(
                f"So row {ROW} is pixel ({VIEW} · {HEIGHT} + {Y}) · {WIDTH} + {X}, and each view has Gaussians of",
                int(made.pixel_ids[ROW]) == ROW and run.prepared.input_scene.has_own_pixels,
            ),
            say(
                "its own, one in front of every pixel.",
                bool(run.prepared.input_scene.pixels.shown.all())
                and int(run.prepared.input_scene.pixels.fronts[VIEW, Y, X]) == ROW,
            ),
        ),
    ])  # fmt: skip


def prepare_section(run: Run) -> str:
    """Write the section on the facts that are known before the first choice."""
    prepared = run.prepared
    agreement, frame = prepared.agreement, prepared.frame
    return "\n\n".join([
        "## 2. prepare: what is known first",
        text(
            "[`prepare/prepare_scene.py`](../../gsmerge/prepare/prepare_scene.py) moves the scene into its canonical",
            "frame and collects facts.",
        ),
        "\n".join([
            entry("frame.origin", frame.origin),
            entry("frame.unit", frame.unit),
            entry("scene.gaussians.means", prepared.scene.gaussians.means, ROW),
            entry("scene.images", prepared.scene.images, (VIEW, Y, X)),
            entry("reference.name", prepared.reference.name),
            entry("agreement.confirmed", f"{agreement.confirmed:.2f}"),
            entry("moved", prepared.moved),
        ]),
        text(
            "The frame has its origin at the median of the means. The frame's unit is the power of two nearest to the",
            "median depth, so thresholds mean the same in every scene.",
            say(
                "The photos show what the Gaussians show, so the fit and all scores refer to them.",
                prepared.reference.name == "photos" and prepared.reference.score_views == tuple(range(VIEWS)),
            ),
            f"Other views confirm the depth of {100 * agreement.confirmed:.0f} % of the pixels.",
            say("The photos agree, so no exposure and no camera changes.",
                not prepared.moved and prepared.reference.photo_files is None),
        ),
    ])  # fmt: skip


def plan_section(run: Run) -> str:
    """Write the section on the decisions before anything is built."""
    plan, pixels = run.made["make_plan"], WIDTH * HEIGHT
    limits, first = plan.limits, int(plan.limits.per_view * plan.superpixels.start_share)
    return "\n\n".join([
        "## 3. make_plan: every decision",
        text(
            "[`plan.py`](../../gsmerge/plan.py) turns options and facts into a `Plan`, which the steps below get in",
            "place of `CompactOptions`.",
        ),
        "\n".join([
            entry("limits.per_view", limits.per_view),
            entry("limits.default", f"{limits.default:,}"),
            entry("superpixels.start_share", plan.superpixels.start_share),
            entry("decode.k", plan.decode.k),
            entry("match.match", plan.match.match),
            entry("fit.steps", plan.fit.steps),
            entry("checkpoint", plan.checkpoint),
        ]),
        text(
            say(
                "No option limits the number of Gaussians, and every Gaussian belongs to a pixel, so"
                f" {plan.settings['superpixels']} of the",
                limits.exact is None and not plan.keeps_fidelity and plan.target_psnr is None,
            ),
            f"{pixels:,} pixels of a view may become Gaussians: {limits.per_view} for each view,",
            f"and {limits.default:,} in all. The fit has {plan.fit.steps} steps. Its start is made of only",
            f"{first} superpixels for each view, and the fit adds Gaussians where renders differ most from the",
            say(
                "photos.",
                plan.fit.grows and not plan.merges_pairs,
            ),
            say(
                "Networks are not used, since a fit to photos gains more.",
                plan.checkpoint is None and run.prepared.reference.of_views,
            ),
        ),
    ])  # fmt: skip


def build_section(run: Run) -> str:
    """Write the section on the steps that build the Gaussians, the arrows of the pipeline."""
    made, at = run.made, run.feature
    groups, features, matches = made["segment_scene"].groups, made["correct"], made["match"]
    merged, decoded, fitted = made["merge"], made["decode_merged"], made["fit_scene"]
    plan, children = made["make_plan"], run.fitted
    size = int(np.diff(features.starts)[at])
    own = np.flatnonzero(matches.clusters == matches.clusters[at])
    faint = int((features.gains < 1).sum())
    report, written = fitted.report, made["build"].gaussians
    before, after = ({mean.tobytes() for mean in some.means} for some in (fitted.gaussians, written))
    others = [row for row, mean in enumerate(written.means) if mean.tobytes() not in before]
    return "\n\n".join([
        "## 4. build: the arrows",
        text(
            "[`pipeline.py`](../../gsmerge/pipeline.py) calls the functions of `stages/` in turn, and `fit/` after",
            "`decode_merged`. Each line begins with a function. Not shown are `assign` (a row belongs to the",
            "superpixel of its pixel) and `refine` (only networks refine).",
        ),
        "\n".join([
            entry("segment_scene: groups.labels", groups.labels, (VIEW, Y, X)),
            entry("encode, correct: features.means", features.means, at),
            entry("encode, correct: features.covars", features.covars, (at, [0, 1, 2], [0, 1, 2]), 4) + " (diagonal)",
            entry("encode, correct: features.gains", features.gains, at),
            entry("match: clusters", matches.clusters, at),
            entry("merge: features.means", merged.means, run.merged),
            entry("decode_merged: gaussians.scales", decoded.gaussians.scales, run.merged, 4),
            entry("fit_scene: gaussians.scales", fitted.gaussians.scales, children[0], 4),
            *[entry("fill_between: gaussians.means", written.means, row) + " (a new one)" for row in others[:1]],
        ]),
        text(
            "**Superpixels** follow colour borders in the photo, because a Gaussian has one colour.",
            say(f"Each view has {groups.counts[0]} superpixels.", len(set(groups.counts)) == 1),
            f"The pixel lies in superpixel {run.label}, which has {size} pixels.",
            "**`encode`** gives each superpixel a Feature Gaussian with the mean and the covariance of its Gaussians,",
            "weighted by their opacities.",
            f"**`correct`** makes {faint} of the {len(features)} Feature Gaussians fainter, because more views see",
            say("through each of them than confirm its depth.", plan.weakens and faint > 0),
        ),
        text(
            "**`match`** finds Feature Gaussians of different views that overlap and have similar colours, and so",
            say(
                "show one surface. The pixel's cluster has one Feature Gaussian of each of the views"
                f" {', '.join(map(str, features.views[own][:-1]))} and {features.views[own][-1]}.",
                len({*features.views[own]}) == len(own) > 1 and plan.match.match == "overlap",
            ),
            f"**`merge`** turns {len(features)} Feature Gaussians into {len(merged)}, one for each cluster; `views` is",
            say("-1 if several views were merged.", int(merged.views[run.merged]) == -1),
            "**`decode_merged`** makes one Gaussian of each merged one,",
            say("since K is 1.", plan.decode.k == 1 and len(decoded.gaussians) == len(merged)),
            "The opacity keeps the optical depth of the members of the cluster, times the gain.",
        ),
        text(
            "**`fit_scene`** changes all parameters so that renders look like the photos. Half way the fit splits the",
            "Gaussians with the largest errors, and later drops faint Gaussians.",
            f"{len(fitted.gaussians):,} Gaussians are left, {len(children)} of which come from the pixel's Gaussian.",
            "The first steps draw a quarter of a photo's pixels, and leave out patches of the photos.",
            f"The PSNR of the patches rises from {report.holdout_before:.1f} to {report.holdout_after:.1f} dB,",
            say(
                "so the fit is accepted.",
                report.accepted and report.method == "full",
            ),
        ),
        text(
            f"**`split_unseen`** finds {len(before - after)} Gaussians that change no photo by more than rounding",
            "does, and they are dropped. **`fill_between`** would fill places that cameras between the photos see",
            say("empty, but this scene has none.", not others),
        ),
    ])  # fmt: skip


def result_section(run: Run) -> str:
    """Write the section on the result and its quality."""
    result, new = run.result, run.result.report.new_views
    gaussians, report, child = result.gaussians, result.report, run.written
    return "\n\n".join([
        "## 5. make_result: what comes out",
        text(
            "[`results/candidate.py`](../../gsmerge/results/candidate.py) moves the Gaussians into the world of",
            "the file and scores them; [`results/result.py`](../../gsmerge/results/result.py) scores the input.",
        ),
        "\n".join([
            entry("result.gaussians.means", gaussians.means, child),
            entry("result.gaussians.opacities", gaussians.opacities, child),
            entry("report.psnr_before", f"{report.psnr_before:.2f}"),
            entry("report.psnr_after", f"{report.psnr_after:.2f}"),
            entry("report.new_views", f"about {new.gain:+.1f} dB"),
        ]),
        text(
            f"{len(gaussians):,} Gaussians replace {run.prepared.input_scene.num_gaussians:,}.",
            say(
                "The result shows the photos better than the input, which has wrong depths.",
                report.psnr_after > report.psnr_before,
            ),
            "The fit has seen these photos, so the report also estimates the gain of new views, by",
            say(
                "fits that leave photos out.",
                report.worse is None and new.low > 0,
            ),
        ),
    ])  # fmt: skip


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
