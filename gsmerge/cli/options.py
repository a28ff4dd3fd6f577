"""The options of the command line, each declared once, and how a command gets them.

A command is a function of one :class:`Args`; :func:`command` lists its parameters for Typer: names of options
declared here, and its own. An option that is a setting of the library carries the setting's name and no default: None
leaves the library's own. What help says about that default and the possible values is compared with the library by
``tests/contract/test_options.py``: the library's classes load torch, which ``--help`` must not.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from enum import Enum
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.io import ReadHints, SceneFiles, SceneLoad
    from gsmerge.options import CompactOptions

INPUT, COUNT, MERGING, FITTING, MEASURING, OUTPUT, GENERAL = (
    "Input", "How many Gaussians", "Merging", "Fitting", "Measuring", "Output", "General"
)  # fmt: skip
REQUIRED = Parameter.empty


class Args(SimpleNamespace):
    """The arguments and options of a command by name; values of choices are plain strings."""

    @property
    def silent(self) -> bool:
        """Whether nothing but data may be printed."""
        return bool(self.quiet or self.json)

    def given(self, names: Iterable[str]) -> dict[str, Any]:
        """Those of the named options that were given."""
        values = vars(self)
        return {name: values[name] for name in names if values.get(name) is not None}

    def settings(self, **changes: Any) -> CompactOptions:
        """The library's options with those that were given, and ``changes``.

        Raises:
            UsageError: If a value is out of range.
        """
        from gsmerge.options import CompactOptions

        options = CompactOptions()
        with usage_errors():
            return options.with_settings(self.given(options.to_dict()) | changes)

    def hints(self) -> ReadHints:
        """How to read the scene.

        Raises:
            UsageError: If a value is none of the possible ones.
        """
        from gsmerge.io import ReadHints
        from gsmerge.io.exporters import find_exporter

        with usage_errors():
            find_exporter(self.exporter)
            return ReadHints(**self.given(("exporter", "quats", "order", "scene_scale", "max_side")))

    def files(self, scene: Path) -> SceneFiles:
        """The scene's .ply, its cameras and its photos: those named, or those beside it."""
        from gsmerge.io import find_scene_files

        return find_scene_files(scene, cameras=self.cameras, images=vars(self).get("images"))

    def load(self, files: SceneFiles) -> SceneLoad:
        """The scene of these files."""
        from gsmerge.io import load_files

        return load_files(files, opacity=self.opacity, hints=self.hints())


@contextmanager
def usage_errors() -> Iterator[None]:
    """A block in which a value that the library refuses is wrong usage of the command."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def argument(name: str, kind: Any, metavar: str, help: str, default: Any = REQUIRED) -> Parameter:
    """A positional argument of a command."""
    info = typer.Argument(metavar=metavar, help=_escape(help))
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def option(
    name: str, kind: Any, help: str, *flags: str, default: Any = None, wording: str | None = None, rare: bool = False,
    **more: Any,
) -> Parameter:  # fmt: skip
    """An option.

    Args:
        name: In :class:`Args`, and on the command line with dashes.
        kind: Its type: bool is a switch, a tuple lists the possible values.
        help: For the reader.
        flags: On the command line, where they are not made of the name.
        default: Value where it is not given.
        wording: How help words the default, where that is left to the library.
        rare: Shown by ``--help-all`` alone.
        more: Passed on to Typer.
    """
    flags = flags or (f"--{name.replace('_', '-')}",)
    if isinstance(kind, tuple):
        choice: Any = Enum  # which mypy knows with literal names alone
        kind = choice(f"{name}_choice", {value: value for value in kind}, type=str)
        default = kind(default) if isinstance(default, str) else default
    kind = kind | None if default is None else kind
    info = typer.Option(*flags, help=_escape(help), show_default=wording or default is not False, hidden=rare, **more)
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def switch(name: str, help: str, *short: str, rare: bool = False, **more: Any) -> Parameter:
    """An option without a value, off where it is not given."""
    return option(name, bool, help, f"--{name.replace('_', '-')}", *short, default=False, rare=rare, **more)


def panel(title: str, *parameters: Parameter) -> tuple[Parameter, ...]:
    """Options of one group in help."""
    for parameter in parameters:
        get_args(parameter.annotation)[1].rich_help_panel = title
    return parameters


def changed(name: str, default: Any = None, **changes: Any) -> Parameter:
    """A declared option as one command has it: another default, ``help``, ``show_default``, ``hidden``, ..."""
    kind, info = get_args(OPTIONS[name].annotation)
    info = copy(info)
    for attribute, value in changes.items():
        setattr(info, attribute, value)
    return OPTIONS[name].replace(default=default, annotation=Annotated[kind, info])


def _escape(help: str) -> str:
    """Text in which rich does not take ``[cuda]`` for markup."""
    return re.sub(r"\[(?=[a-z])", r"\\[", help)


def command(*parameters: str | Parameter) -> Callable[[Callable[[Args], None]], Callable[..., None]]:
    """Give a command its parameters, in the order of help.

    Args:
        parameters: Names of declared options with spaces between, and parameters of the command alone.
    """
    listed: dict[str, Parameter] = {}
    for given in (*parameters, "json quiet debug help_all"):
        for name in given.split() if isinstance(given, str) else [given.name]:
            listed.setdefault(name, OPTIONS[name] if isinstance(given, str) else given)

    def decorate(function: Callable[[Args], None]) -> Callable[..., None]:
        @wraps(function)
        def run(**values: Any) -> None:
            plain = {name: value.value if isinstance(value, Enum) else value for name, value in values.items()}
            function(Args(**plain))

        run.__signature__ = Signature(list(listed.values()))  # type: ignore[attr-defined]
        run.__annotations__ = {}
        return run

    return decorate


def _show_all(context: typer.Context, value: bool) -> None:
    """``--help-all``."""
    if value:
        for parameter in context.command.params:
            parameter.hidden = False  # type: ignore[attr-defined]
        print(context.get_help())
        raise typer.Exit


def parse_k(text: str) -> int | str:
    """``--k``: a number from 1 to 8, or mixed."""
    if text == "mixed":
        return text
    if not text.isdigit() or not 1 <= int(text) <= 8:
        raise typer.BadParameter(f"expected 1 to 8 or mixed, got {text!r}")
    return int(text)


def parse_photo_scale(text: str) -> float | str:
    """``--photo-scale``: a number from 1, or auto."""
    try:
        return text if text == "auto" else float(text)
    except ValueError as error:
        raise typer.BadParameter(f"expected a number from 1 or auto, got {text!r}") from error


def parse_superpixels(text: str) -> int | str:
    """``--superpixels``: a number, a share, or auto."""
    return int(text) if text.isdigit() else text


BEFORE = argument("before", Path, "BEFORE", "The scene: a .ply or its folder.")
AFTER = argument("after", list[Path], "AFTER...", "Compact files of that scene: .ply, .spz, .sog or .splat.")
SCENE = argument("scene", Path, "SCENE", "A .ply with one Gaussian per pixel and view, or the folder it is in.")

# What commands share: a text, and names of options
COMPACT_SCENE = "The compact scene: .ply, .compressed.ply, .spz, .sog, .splat or .glb, by its name."
HINTS = "opacity exporter quats order scene_scale max_side"
READING = f"cameras images {HINTS}"
TARGETS = "targets target_images"
COUNTS = "k k_low k_high k_rule superpixels budget quality levels"
MERGE = "segmentation match geometry neighbors overlap iou similarity max_color unseen min_opacity"
CLEAN = "crop drop_floaters drop_sky"
FIT = "fit effort device fit_steps photo_scale time_budget poses"
NETWORKS = "recipe checkpoint require_checkpoint"
RUN = "seed threads"

_TABLE = (
    panel(
        INPUT,
        option("cameras", Path, "Camera file or COLMAP folder: transforms.json, cameras.json, results.npz, ... "
               "Default: beside the .ply."),
        option("images", Path, "Folder of the input photos. Default: beside the .ply."),
        option("opacity", ("auto", "logit", "raw"), "How the file stores opacity: as logits, or raw in [0, 1]; auto "
               "decides by the values.", default="auto", rare=True),
        option("exporter", str, "The program that wrote the file, such as da3 or depthsplat; auto recognises it.",
               default="auto", rare=True),
        option("quats", ("auto", "wxyz", "xyzw", "xyzw-root", "camera"), "How the file stores rotations: w first, w "
               "last, or relative to each view's camera.", default="auto", rare=True),
        option("order", ("auto", "view-major", "view-fastest", "layer-major", "column-major", "unordered", "none"),
               "Order of the rows; none: the Gaussians belong to no pixels.", default="auto", rare=True),
        option("scene_scale", float, "Size of the Gaussians' world in units of the cameras'.", wording="estimated",
               rare=True),
        option("max_side", int, "Longest side of a view, pixels, where the Gaussians belong to no pixels; larger "
               "photos are resized.", wording="1200", rare=True, min=16),
        option("targets", Path, "Cameras of held-out photos, in any camera file; views that the scene was made of are "
               "left out."),
        option("target_images", Path, "Folder of the held-out photos. Default: beside their cameras."),
    ),
    panel(
        COUNT,
        option("k", str, "Gaussians per superpixel: finer with more; mixed: 1, 2 or 4 by its saliency.", wording="1",
               parser=parse_k, metavar="1-8|mixed"),
        option("k_low", float, "Percentile of saliency up to which a mixed k is 1.", wording="50.0", rare=True),
        option("k_high", float, "Percentile of saliency above which a mixed k is 4.", wording="85.0", rare=True),
        option("k_rule", ("saliency", "distortion"), "What a mixed k goes by: the corner response of the photos, or "
               "as many Gaussians where they lower distortion most.", wording="saliency", rare=True),
        option("superpixels", str, "Superpixels per view: a number such as 3000, a share of its pixels, or auto: 1.5 "
               "to 8 %, the more the better the depths of the views agree.", wording="4.4%", parser=parse_superpixels,
               metavar="NUMBER|SHARE|auto"),
        option("budget", str, "Gaussians in the result: a number, a share such as 2% of the input, or a size such as "
               "5MB, met exactly; quest3, mobile or desktop: at most what it draws fluidly; auto: as many as the scene "
               "needs.", metavar="40000|2%|5MB|DEVICE|auto"),
        option("quality", str, "Fewest Gaussians that render the input photos at a PSNR such as 30dB, or that lose at "
               "most so much against the best, such as -0.2dB.", metavar="30dB|-0.2dB"),
        option("levels", int, "Levels of detail, each in a file of its own, with a quarter of the Gaussians of the "
               "one before.", wording="1", rare=True, min=1, max=8),
        option("max_k", int, "Most Gaussians per superpixel that can be decoded later: more take more space.",
               wording="4, or 8 with a --budget", min=1, max=8),
    ),
    panel(
        MERGING,
        option("segmentation", ("rdseg", "bass", "bass-st", "bass-adaptive", "slic", "grid"), "Superpixel method.",
               wording="rdseg", rare=True),
        option("match", ("overlap", "aabb", "none"), "How Gaussians of different views are matched and merged.",
               wording="overlap, none for a draft", rare=True),
        option("geometry", ("analytic", "decoded"), "What is matched where networks are loaded: moments, or the "
               "output of the K = 1 head.", wording="analytic", rare=True),
        option("neighbors", int, "Nearest neighbours in other views that are compared.", wording="16", rare=True,
               min=1),
        option("overlap", float, "Least overlap of Gaussians that --match overlap merges.", wording="0.7", rare=True),
        option("iou", float, "Least intersection over union of boxes that --match aabb merges.", wording="0.2",
               rare=True),
        option("similarity", float, "Least cosine of the networks' latents that --match aabb merges.", wording="0.8",
               rare=True),
        option("max_color", float, "Largest difference of colours that are merged.", wording="0.12", rare=True),
        option("min_opacity", float, "Gaussians below this opacity are left out.", wording="1/255", rare=True),
        option("unseen", ("drop", "keep"), "Gaussians that no view sees, where they are not one per pixel: drop (the "
               "default), or keep, merged.", rare=True),
        option("method", (
            "gsmerge", "unmerged", "unmerged-fit", "moment-matching", "voxel", "opacity",
            "contribution", "random", "blocks", "greedy", "splat-transform",
        ), "gsmerge, or a baseline to compare it with.", wording="gsmerge", rare=True),
        option("recipe", ("paper",), "Settings that belong together. paper: the superpixel merging paper's own method, "
               "with networks that have absolute outputs.", rare=True),
        option("checkpoint", str, "Trained networks that correct the analytic stages: a file, shipped, paper, none, or "
               "auto: the shipped ones where they improve the result.", wording="auto", rare=True, metavar="FILE|NAME"),
        option("require_checkpoint", bool, "A checkpoint that cannot be used is an error instead of a note.",
               "--require-checkpoint", rare=True),
    ),
    panel(
        FITTING,
        option("fit", ("full", "none"), "What is fitted to the photos.", wording="full"),
        option("effort", ("draft", "fast", "default", "best"), "How much work goes into superpixels and fit.",
               wording="default"),
        option("device", ("cpu", "cuda", "auto"), "Where the fit and the scores run; cuda needs gsmerge[cuda]. auto: "
               "a GPU where there is one and the scene is large enough.", wording="cpu"),
        option("fit_steps", int, "Steps of the full fit. By default more Gaussians get more.", wording="by effort",
               rare=True, min=1),
        option("photo_scale", str, "Fit to photos that are larger than the views at up to so many times the views' "
               "size, for sharper results up close; auto: up to 2.", wording="auto", rare=True,
               parser=parse_photo_scale, metavar="NUMBER|auto"),
        option("time_budget", float, "Seconds that the full fit may take.", rare=True, min=0.0),
        option("poses", ("auto", "fixed", "free"), "Whether cameras are moved to where the photos agree: free, fixed, "
               "or auto: where some are wrong.", wording="auto", rare=True),
    ),
    panel(
        OUTPUT,
        option("crop", str, "Keep the Gaussians inside a sphere:x,y,z,radius or box:x0,y0,z0,x1,y1,z1, in the scene's "
               "world units; a budget is met after it.", metavar="SHAPE"),
        option("drop_floaters", bool, "Leave out Gaussians that are isolated or far beyond the scene.",
               "--drop-floaters", rare=True),
        option("drop_sky", bool, "Leave out Gaussians that are sky in the photos.", "--drop-sky", rare=True),
    ),
    panel(
        MEASURING,
        option("lpips", ("both", "vgg", "alex", "none"), "Networks of the perceptual distance; none is much faster.",
               wording="both, where installed"),
        option("lpips_views", int, "Measure LPIPS on at most so many views of each split.", wording="all", min=1),
    ),
    panel(
        OUTPUT,
        option("output", Path, "", "--output", "-o"),
        switch("antialiased", "Lower the opacity of small Gaussians by what the low-pass adds to them, as some viewers "
               "do (Mip-Splatting)."),
        switch("no_normals", "Leave the three columns of zeros out of a .ply, 12 of its 68 bytes per Gaussian; a "
               "--budget in bytes counts them.", rare=True),
        option("spz_version", int, "Version of a .spz: 3, which most programs read, or 4, with room for harmonics of "
               "degree 4; it needs gsmerge[spz4].", default=3, rare=True, min=3, max=4),
        switch("overwrite", "Replace the output if it exists."),
        option("report", Path, "Write the JSON report to this file."),
        switch("no_viewer_cameras", "Do not write the input views beside the result, as NAME.cameras.json for viewers.",
               rare=True),
        option("save_cameras", Path, "Write the cameras as used, moved where they were wrong, as transforms.json.",
               rare=True),
        switch("dry_run", "Print what would be done; write nothing."),
        switch("json", "Print JSON on stdout."),
    ),
    panel(
        GENERAL,
        option("seed", int, "Seed of all random numbers.", wording="0", rare=True, min=0),
        option("threads", int, "Threads; the result does not depend on their number.", wording="all processors",
               rare=True, min=1),
        switch("quiet", "Print errors only.", "-q", rare=True),
        switch("debug", "Print tracebacks of errors.", rare=True),
    ),
    panel("Options", switch("help_all", "Show all options and exit.", is_eager=True, callback=_show_all,
                            expose_value=False)),
)  # fmt: skip
OPTIONS = {parameter.name: parameter for parameters in _TABLE for parameter in parameters}


def output(help: str, wording: str | None = None, default: Any = None) -> Parameter:
    """``-o/--output``: the file or folder that a command writes its result to; ``default`` may be REQUIRED."""
    return changed("output", default, help=help, show_default=wording or default is not REQUIRED)
