"""Declare the options of the command line, each once, and make settings of them.

A command is a function of one :class:`Args`; :func:`command` lists its parameters for Typer: names of options
declared here, and its own. An option that is a setting of the library carries the setting's name and no default.
The defaults and values in help are compared with the library by ``tests/contract/test_options.py``: the library's
classes load torch, which ``--help`` must not.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from enum import Enum
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer

from gsmerge.errors import UsageError
from gsmerge.runtime.plugins import METHODS, find_plugins

if TYPE_CHECKING:
    from gsmerge.io.formats.read import OpacityChoice
    from gsmerge.options import CompactOptions
    from gsmerge.scene.exporters import ReadHints
    from gsmerge.scene.files import SceneFiles
    from gsmerge.scene.read import Loaded

INPUT, COUNT, METHOD, MEASURING, OUTPUT, GENERAL = (
    "Input", "How many Gaussians", "Method", "Measuring", "Output", "General"
)  # fmt: skip
REQUIRED = Parameter.empty
SETTINGS_PAGE = "docs/reference/settings.md"

# Names for --hint, and the meaning; defaults and values are those of the library
HINTS = {
    "opacity": "How the file stores opacity: as logits, or raw in [0, 1]; auto decides by the values.",
    "exporter": "The program that wrote the file, such as da3 or depthsplat; auto recognises it.",
    "quats": "How the file stores rotations: w first, w last, w last and applied twice, or relative to each view's "
             "camera.",
    "order": "Order of the rows; none: the Gaussians belong to no pixels.",
    "scene_scale": "Size of the Gaussians' world in units of the cameras'; null: it is estimated.",
    "max_side": "Longest side of a view, pixels, where the Gaussians belong to no pixels; larger photos are resized.",
}  # fmt: skip


class Args(SimpleNamespace):
    """The arguments and options of a command by name; values of choices are plain strings."""

    @property
    def silent(self) -> bool:
        """Whether only data may be printed."""
        return bool(self.quiet or self.json)

    def given(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the named options that were given."""
        values = vars(self)
        return {name: values[name] for name in names if values.get(name) is not None}

    def make(self, *kinds: type, **changes: Any) -> list[Any]:
        """Make settings of the dataclasses ``kinds`` from options, ``--set`` and fixed ``changes``; UsageError if
        wrong.
        """
        values = self.values(*kinds, but=changes) | changes
        own = [{name: values[name] for name in setting_kinds(kind) if name in values} for kind in kinds]
        with usage_errors():
            return [
                kind().with_settings(some) if hasattr(kind, "with_settings") else kind(**some)
                for kind, some in zip(kinds, own, strict=True)
            ]

    def values(self, *kinds: type, but: Collection[str] = ()) -> dict[str, Any]:
        """Collect the settings of these kinds that were given, by flat name, without the names in ``but``."""
        known = {name: kind for one in kinds for name, kind in setting_kinds(one).items() if name not in but}
        own = self.given(known)
        chosen = parse_pairs("--set", vars(self).get("set") or (), known)
        for name in own.keys() & chosen.keys():
            raise UsageError(f"--set {name}: expected it once, got --{name.replace('_', '-')} too")
        return own | chosen

    def settings(self, **changes: Any) -> CompactOptions:
        """Make the library's options, as :meth:`make` does."""
        from gsmerge.options import CompactOptions

        made: CompactOptions = self.make(CompactOptions, **changes)[0]
        return made

    @property
    def opacity(self) -> OpacityChoice:
        """Storage of opacities in the file, from ``--hint``."""
        choice: OpacityChoice = self._parse_hints().get("opacity", "auto")
        return choice

    def hints(self, **defaults: Any) -> ReadHints:
        """Make the hints on how to read the scene, on top of ``defaults``; UsageError for an unknown name or value."""
        from gsmerge.scene.exporters import ReadHints, find_exporter

        values = {name: value for name, value in self._parse_hints().items() if name != "opacity"}
        with usage_errors():
            find_exporter(values.get("exporter", "auto"))
            return ReadHints(**{**defaults, **values})

    def _parse_hints(self) -> dict[str, Any]:
        from gsmerge.io.formats.read import OpacityChoice
        from gsmerge.scene.exporters import ReadHints

        return parse_pairs("--hint", self.hint or (), setting_kinds(ReadHints) | {"opacity": OpacityChoice})

    def files(self, scene: Path, *more: Path) -> SceneFiles:
        """Find the .ply, cameras and photos of a scene, and of others to join with it.

        Cameras and photos are the named ones, or those beside each.
        """
        from gsmerge.scene.files import find_scene_files

        places = {"cameras": self.cameras, **{name: vars(self).get(name) for name in ("images", "masks")}}
        first, *others = (find_scene_files(one, **places) for one in (scene, *more))
        return replace(first, more=tuple(others))

    def load(self, files: SceneFiles, **defaults: Any) -> Loaded:
        """Read the scene of these files; ``defaults`` are hints that the user may override."""
        from gsmerge.scene.read import load_files

        return load_files(files, opacity=self.opacity, hints=self.hints(**defaults))


def setting_kinds(options: Any) -> dict[str, Any]:
    """List the settings of a dataclass by flat name with their types; a stage's own settings replace the stage."""
    hints, kinds = get_type_hints(options), dict[str, Any]()
    for field in fields(options):
        kind = hints[field.name]
        if field.metadata.get("setting", True):
            kinds |= setting_kinds(kind) if is_dataclass(kind) else {field.name: kind}
    return kinds


def parse_pairs(flag: str, pairs: Iterable[str], kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Parse the NAME=VALUE of ``--set`` or ``--hint``, as JSON where that fits; UsageError if one is wrong."""
    values: dict[str, Any] = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not sign:
            raise UsageError(f"{flag}: expected NAME=VALUE, got {pair!r}")
        if name not in kinds:
            near = get_close_matches(name, kinds, 1, 0)[0]
            raise UsageError(f"{flag} {name}: unknown, the closest name is {near}; {SETTINGS_PAGE} lists all")
        if name in values:
            raise UsageError(f"{flag} {name}: expected it once, got it twice")
        readings: list[Any] = [text]
        with suppress(ValueError, RecursionError):
            readings.insert(0, json.loads(text))
        fitting = [value for value in readings if _fits(value, kinds[name])]
        if not fitting:
            raise UsageError(f"{flag} {name}: expected {words_for(kinds[name])}, got {text!r}")
        values[name] = fitting[0]
    return values


def _fits(value: Any, kind: Any) -> bool:
    """Return whether a value is of a type, which may be a union or a list of literals."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_args(kind):
        return any(_fits(value, one) for one in get_args(kind))
    if kind in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, (int, float) if kind is float else kind)


def words_for(kind: Any) -> str:
    """Describe the values of a type: possible words, or a kind of value."""
    plain = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "null"}
    words: list[str] = []
    for one in [kind] if get_origin(kind) is tuple else get_args(kind) or [kind]:
        parts = get_args(one) if get_origin(one) is Literal else [one]
        words += [part if isinstance(part, str) else plain.get(part, "a list") for part in parts]
    return " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turn a value that the library refuses into wrong usage of the command."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def argument(name: str, kind: Any, metavar: str, help: str, default: Any = REQUIRED) -> Parameter:
    """Declare a positional argument of a command."""
    info = typer.Argument(metavar=metavar, help=_escape(help))
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def option(
    name: str, kind: Any, help: str, *flags: str, default: Any = None, wording: str | None = None, **more: Any,
) -> Parameter:  # fmt: skip
    """Declare an option; ``kind`` bool is a switch, a tuple lists the possible values.

    ``flags`` are needed where they are not made of the name. ``wording`` is the default in help, where the library
    decides it; ``more`` goes to Typer.
    """
    flags = flags or (f"--{name.replace('_', '-')}",)
    if isinstance(kind, tuple):
        choice: Any = Enum  # which mypy knows with literal names alone
        kind = choice(f"{name}_choice", {value: value for value in kind}, type=str)
        default = kind(default) if isinstance(default, str) else default
    kind = kind | None if default is None else kind
    info = typer.Option(*flags, help=_escape(help), show_default=wording or default is not False, **more)
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def switch(name: str, help: str, *short: str, **more: Any) -> Parameter:
    """Declare an option without a value, off where it is not given."""
    return option(name, bool, help, f"--{name.replace('_', '-')}", *short, default=False, **more)


def panel(title: str, *parameters: Parameter) -> tuple[Parameter, ...]:
    """Group options under a title in help."""
    for parameter in parameters:
        get_args(parameter.annotation)[1].rich_help_panel = title
    return parameters


def changed(name: str, default: Any = None, **changes: Any) -> Parameter:
    """Change a declared option for one command: its default, ``help``, ``show_default``, ``hidden``, ..."""
    return _change(OPTIONS[name], **changes).replace(default=default)


def _change(parameter: Parameter, **changes: Any) -> Parameter:
    kind, info = get_args(parameter.annotation)
    info = copy(info)
    for attribute, value in changes.items():
        setattr(info, attribute, value)
    return parameter.replace(annotation=Annotated[kind, info])


def _escape(help: str) -> str:
    """Escape brackets, so that rich does not take ``[cuda]`` for markup."""
    return re.sub(r"\[(?=[a-z])", r"\\[", help)


def command(*parameters: str | Parameter, rare: str = "") -> Callable[[Callable[[Args], None]], Callable[..., None]]:
    """Give a command its parameters in the order of help; ``rare`` names are shown by ``--help-all`` alone."""
    listed: dict[str, Parameter] = {}
    for given in (*parameters, "json quiet", *(["help_all"] if rare else [])):
        for name in given.split() if isinstance(given, str) else [given.name]:
            listed.setdefault(name, OPTIONS[name] if isinstance(given, str) else given)
    for name in rare.split():
        listed[name] = _change(listed[name], hidden=True)

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
    """Print help with the options that it leaves out otherwise."""
    if value:
        for parameter in context.command.params:
            parameter.hidden = False  # type: ignore[attr-defined]
        print(context.get_help())
        raise typer.Exit


def number_or_text(text: str) -> int | str:
    """Parse ``--k`` or ``--superpixels``: a number, or a word that the library knows."""
    return int(text) if text.isdecimal() else text


BEFORE = argument("before", Path, "BEFORE", "The scene: a .ply or its folder.")
AFTER = argument(
    "after", list[Path] | None, "[AFTER]...", "Compact files of that scene: .ply, .spz, .sog or .splat.", default=None
)
SCENE = argument("scene", Path, "SCENE", "A .ply with one Gaussian per pixel and view, or the folder it is in.")

# What commands share: a text, and names of options
COMPACT_SCENE = "The compact scene: .ply, .compressed.ply, .spz, .sog, .splat or .glb, by its name."
READING = "cameras images hint"
TARGETS = "targets target_images"
RUN = "seed threads"

_TABLE = (
    panel(
        INPUT,
        option("cameras", Path, "Camera file or COLMAP folder: transforms.json, cameras.json, results.npz, ... "
               "Default: beside the .ply."),
        option("images", Path, "Folder of the input photos. Default: beside the .ply."),
        option("masks", Path, "Folder of images named as the photos, dark where a photo does not count. Default: masks "
               "beside the photos, and where these are transparent."),
        option("hint", list[str], "How to read the file, where it is recognised wrongly: opacity, exporter, quats, "
               "order, scene_scale or max_side, such as order=none; may be repeated.", metavar="NAME=VALUE"),
        option("targets", Path, "Cameras of held-out photos, in any camera file; views that the scene was made of are "
               "left out."),
        option("target_images", Path, "Folder of the held-out photos. Default: beside their cameras."),
    ),
    panel(
        COUNT,
        option("k", str, "Gaussians per superpixel: finer with more; mixed: 1, 2 or 4 by its saliency; auto: 1, and 4 "
               "for one photo without a long fit.", wording="auto", parser=number_or_text, metavar="1-8|mixed|auto"),
        option("superpixels", str, "Superpixels per view: a number such as 3000, a share of its pixels, or auto: 1.5 "
               "to 8 %, the more the better the depths of the views agree.", wording="4.4%", parser=number_or_text,
               metavar="NUMBER|SHARE|auto"),
        option("budget", str, "Gaussians in the result: a number, a share such as 2% of the input, or a size such as "
               "5MB, met exactly; quest3, mobile or desktop: at most what it draws fluidly; auto: as many as the scene "
               "needs.", metavar="40000|2%|5MB|DEVICE|auto"),
        option("quality", str, "Fewest Gaussians that render the input photos at a PSNR such as 30dB, or that lose at "
               "most so much against the best, such as -0.2dB.", metavar="30dB|-0.2dB"),
        option("levels", int, "Levels of detail, each in a file of its own or all in a lod-meta.json, with a quarter "
               "of the Gaussians of the one before.", wording="1, or 3 in a lod-meta.json", min=1, max=8),
        option("blocks", str, "Blocks of views that are compacted one by one, for scenes of hundreds of views; auto: "
               "from 20 million Gaussians on, one for every 8 million.", wording="auto", parser=number_or_text,
               metavar="auto|none|NUMBER"),
        option("max_k", int, "Most Gaussians per superpixel that can be decoded later: more take more space.",
               wording="4, or 8 with a --budget", min=1, max=8),
    ),
    panel(
        METHOD,
        option("effort", ("draft", "fast", "default", "best"), "How much work goes into superpixels and fit.",
               wording="default"),
        option("fit", ("full", "none"), "What is fitted to the photos.", wording="full"),
        option("exposure", ("auto", "fixed", "per-photo"), "Bring photos that differ in exposure or white balance to "
               "their mean: where they differ at random, never, or always.", wording="auto"),
        option("device", ("cpu", "cuda", "auto"), "Where the fit and the scores run; cuda needs gsmerge[cuda]. auto: "
               "a GPU where there is one and the scene is large enough.", wording="cpu"),
        option("method", ("gsmerge", *find_plugins(METHODS)), "gsmerge, or a baseline to compare it with.",
               wording="gsmerge"),
        option("recipe", ("paper",), "Settings that belong together. paper: the superpixel merging paper's own method, "
               "with networks that have absolute outputs."),
        option("checkpoint", str, "Trained networks that correct the analytic stages: a file, shipped, paper, none, or "
               "auto: the shipped ones where they improve the result.", wording="auto", metavar="FILE|NAME"),
        option("set", list[str], f"Any other setting, such as poses=fixed; may be repeated. {SETTINGS_PAGE} lists "
               "them.", metavar="NAME=VALUE"),
    ),
    panel(
        MEASURING,
        option("photo_side", int, "Resize larger photos and their cameras to so many pixels on the longer side; the "
               "paper measures at 476.", wording="as they are", min=0),
        option("lpips", ("both", "vgg", "alex", "none"), "Networks of the perceptual distance; none is much faster.",
               wording="both, where installed"),
        option("lpips_views", int, "Measure LPIPS on at most so many views of each split.", wording="all", min=1),
    ),
    panel(
        OUTPUT,
        option("crop", str, "Keep the Gaussians inside a sphere:x,y,z,radius or box:x0,y0,z0,x1,y1,z1, in the scene's "
               "world units; a budget is met after it.", metavar="SHAPE"),
        option("output", Path, "", "--output", "-o"),
        switch("antialiased", "Lower the opacity of small Gaussians by what the low-pass adds to them, as some viewers "
               "do (Mip-Splatting)."),
        switch("overwrite", "Replace the output if it exists."),
        switch("strict", "Exit with code 4, once all is written, where a result shows the scene's own photos worse "
               "than the input does, by more than .5 dB."),
        option("report", Path, "Write the JSON report to this file."),
        option("save_cameras", Path, "Write the cameras as used, moved where they were wrong, as transforms.json."),
        switch("embed_cameras", "Write the cameras as used into the .ply, too, as comments that other programs skip."),
        switch("dry_run", "Print what would be done; write nothing."),
        switch("json", "Print JSON on stdout."),
    ),
    panel(
        "Running",
        option("engine", ("local", "ray"), "Where scenes, or the blocks of one, are compacted. local: on this machine; "
               "ray: a Ray cluster, gsmerge[ray].", default="local"),
        option("address", str, "Address of the Ray cluster, such as auto or HOST:PORT.",
               wording="one of this machine"),
    ),
    panel(
        GENERAL,
        option("seed", int, "Seed of all random numbers.", wording="0", min=0),
        option("threads", int, "Threads; the result does not depend on their number.", wording="all processors",
               min=1),
        switch("quiet", "Print errors only.", "-q"),
    ),
    panel("Options", switch("help_all", "Show all options and exit.", is_eager=True, callback=_show_all,
                            expose_value=False)),
)  # fmt: skip
OPTIONS = {parameter.name: parameter for parameters in _TABLE for parameter in parameters}


def output(help: str, wording: str | None = None, default: Any = None) -> Parameter:
    """Declare ``-o/--output`` of a command: its result, a file or a folder; ``default`` may be REQUIRED."""
    return changed("output", default, help=help, show_default=wording or default is not REQUIRED)
