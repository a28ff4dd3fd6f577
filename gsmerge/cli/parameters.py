"""Declare the options of the command line, each once, and make settings of them.

A command is a function of one :class:`Args`; :func:`command` lists its parameters for Typer: names of options
declared here, and its own. An option that is a setting of the library carries the setting's name and no default; its
help, values and default in words are those of the setting (:func:`setting_option`).
"""

from __future__ import annotations

import json
import os
import re
import shutil
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import replace
from enum import Enum
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from types import NoneType, SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from gsmerge.cli.console import opening_line
from gsmerge.errors import UsageError
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.settings.budget import parse_share
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import NETS, EvaluateOptions
from gsmerge.settings.placement import PlacementOptions
from gsmerge.settings.reading import NONE, FileHints, OpacityChoice, ReadHints
from gsmerge.settings.setting import Setting, change_settings, find_near_names, flat_settings, join_words, suggest_name
from gsmerge.settings.stages import CROP_FILES, Engine

if TYPE_CHECKING:
    from gsmerge.scene.files import SceneFiles
    from gsmerge.scene.read import Loaded

INPUT, COUNT, METHOD, MEASURING, OUTPUT, GENERAL = (
    "Input", "How many Gaussians", "Method", "Measuring", "Output", "General"
)  # fmt: skip
# In the help, of plain values
METAVARS = {bool: "", int: "NUMBER", float: "NUMBER", str: "TEXT", Path: "PATH", list[Path]: "PATH"}
REQUIRED = Parameter.empty
LIST = "help"  # for which --set prints all settings
SEED = "GSMERGE_SEED"  # of the environment: the seed where a command is given none
MAX_DIGITS = 1000  # of such a seed, far fewer than Python refuses

SETTINGS = {
    setting.name: setting for kind in (EvaluateOptions, Engine, PlacementOptions, CompactOptions)
    for setting in flat_settings(kind).values()
}  # fmt: skip


class Args(SimpleNamespace):
    """Arguments and options of a command, by name; values of choices are plain strings."""

    @property
    def silent(self) -> bool:
        """Whether to print data only."""
        return bool(self.quiet or self.json)

    def given(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the subset of the named options that the user gave."""
        values = vars(self)
        return {name: values[name] for name in names if values.get(name) is not None}

    def require_scene(self, names: Collection[str], path: Path) -> None:
        """Raise UsageError for an option not in ``names``, those that Feature Gaussians, the input ``path``, take."""
        for name, value in vars(self).items():
            if value and name not in names and value != OPTIONS[name].default:
                flag = f"--{name.replace('_', '-')}"
                raise UsageError(
                    f"{flag}: expected a scene with it, {path} holds Feature Gaussians, whose number --k decides"
                )

    def make(self, *kinds: type, **changes: Any) -> list[Any]:
        """Make settings of classes ``kinds`` from options, ``--set`` and ``changes``; UsageError if one is wrong."""
        values = self.values(*kinds, but=changes) | changes
        settings = [{name: values[name] for name in flat_settings(kind) if name in values} for kind in kinds]
        with usage_errors():
            return [
                kind().with_settings(arguments) if kind is CompactOptions else change_settings(kind(), arguments)
                for kind, arguments in zip(kinds, settings, strict=True)
            ]

    def values(self, *kinds: type, but: Collection[str] = ()) -> dict[str, Any]:
        """Collect the user's settings of the classes ``kinds`` by flat name, without the names in ``but``."""
        settings = {name: setting for kind in kinds for name, setting in flat_settings(kind).items() if name not in but}
        options = self.given(settings)
        chosen = parse_pairs("--set", vars(self).get("set") or (), settings)
        for name in options.keys() & chosen.keys():
            raise UsageError(f"--set {name}: expected it once, got --{name.replace('_', '-')} too")
        values = options | chosen
        if "seed" in settings:
            values |= {"seed": values["seed"]} if "seed" in values else _environment_seed()
        if Path(str(values.get("crop"))).suffix.lower() in CROP_FILES:
            from gsmerge.io.crop_file import read_crop

            values["crop"] = read_crop(Path(values["crop"]))
        return values

    def settings(self, **changes: Any) -> CompactOptions:
        """Make the options of :func:`gsmerge.compact`, as :meth:`make` does."""
        made: CompactOptions = self.make(CompactOptions, **changes)[0]
        return made

    @property
    def opacity(self) -> OpacityChoice:
        """Encoding of opacities in the file, from ``--hint``."""
        choice: OpacityChoice = self._parse_hints().get("opacity", "auto")
        return choice

    def hints(self, **defaults: Any) -> ReadHints:
        """Make the hints for reading the scene, on top of ``defaults``; UsageError for an unknown name or value."""
        from gsmerge.scene.exporters import find_exporter

        values = {name: value for name, value in self._parse_hints().items() if name != "opacity"}
        with usage_errors():
            find_exporter(values.get("exporter", "auto"))
            return ReadHints(**{**defaults, **values})

    def _parse_hints(self) -> dict[str, Any]:
        return parse_pairs("--hint", self.hint or (), flat_settings(FileHints))

    def files(self, scene: Path, *more: Path) -> SceneFiles:
        """Find the .ply, cameras and photos of a scene, and of further scenes to join with it.

        Cameras and photos are those that the user named, or those beside each scene.
        """
        from gsmerge.scene.files import find_scene_files

        places = {"cameras": self.cameras, **{name: vars(self).get(name) for name in ("images", "masks", "protect")}}
        first, *others = (find_scene_files(path, **places) for path in (scene, *more))
        return replace(first, more=tuple(others))

    def load(self, files: SceneFiles, **defaults: Any) -> Loaded:
        """Read the scene of ``files``, or take it from the command that called this one and has ``loaded`` it.

        ``defaults``: hints to use unless the user gave others.
        """
        from gsmerge.scene.read import load_files

        loaded: Loaded | None = vars(self).get("loaded")
        return (
            loaded
            if loaded and loaded.files == files
            else load_files(files, opacity=self.opacity, hints=self.hints(**defaults))
        )


def parse_pairs(flag: str, pairs: Iterable[str], settings: Mapping[str, Setting]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs of ``--set`` or ``--hint``, values as JSON where possible; UsageError if one is wrong."""
    values: dict[str, Any] = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not sign:
            raise UsageError(f"{flag}: expected NAME=VALUE, got {pair!r}")
        if name not in settings:
            near = join_words(find_near_names(name, settings, 3, 0.5))
            near = f"; perhaps {near}" if near else ""
            more = f"{flag} {LIST} lists all" if flag == "--set" else f"expected {join_words(settings)}"
            raise UsageError(f"{flag} {name}: unknown{near}; {more}")
        if name in values:
            raise UsageError(f"{flag} {name}: expected it once, got it twice")
        readings = _read_value(text)
        if settings[name].is_list:
            readings.append([_read_value(part.strip())[0] for part in text.split(",")])
        fitting = [value for value in readings if settings[name].fits(value)]
        if not fitting:
            expected, near = settings[name].expected(readings[0], null=True), suggest_name(text, settings[name].words)
            raise UsageError(f"{flag} {name}: expected {expected}, got {text!r}{near}")
        values[name] = fitting[0]
    return values


def _read_value(text: str) -> list[Any]:
    """Read a value as JSON or as a number, where it is one, and as text."""
    readings: list[Any] = [text]
    for read in (float, json.loads):
        with suppress(ValueError, RecursionError):
            readings.insert(0, read(text))
    return readings


def _environment_seed() -> dict[str, int]:
    """Return the seed of the environment, if there is one; UsageError if it is no seed."""
    text = os.environ.get(SEED)
    if not text:  # an empty variable is one that is not set
        return {}
    if not (text.isascii() and text.isdecimal() and len(text) <= MAX_DIGITS):
        raise UsageError(f"{SEED}: expected a whole number from 0 of at most {MAX_DIGITS} digits, got {text!r:.40}")
    return {"seed": int(text)}


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turn a ValueError of the library in the block into a UsageError."""
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
    """Declare an option of a command; ``kind`` bool makes a switch, a tuple lists the possible values.

    ``flags``: needed if they cannot be derived from the name. ``wording``: the default in words, if the library decides
    it; ``more`` is passed to Typer.
    """
    flags = flags or (f"--{name.replace('_', '-')}",)
    if more.get("metavar") is None:
        more["metavar"] = "|".join(kind) if isinstance(kind, tuple) else METAVARS.get(kind)
    if isinstance(kind, tuple):
        choice: Any = Enum  # which mypy knows with literal names alone
        kind = choice(f"{name}_choice", {value: value for value in kind}, type=str)
        default = kind(default) if isinstance(default, str) else default
    kind = kind | None if default is None else kind
    info = typer.Option(*flags, help=_escape(help), show_default=wording or default is not False, **more)
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def setting_option(name: str, *flags: str, **more: Any) -> Parameter:
    """Declare an option for a setting of the library, with its help and values; ``more``: passed to :func:`option`."""
    declared = SETTINGS[name]
    kinds = [kind for kind in declared.kinds if kind is not NoneType]
    kind: Any = str if len(kinds) > 1 or (kinds and declared.words) else kinds[0] if kinds else declared.words
    if kind is bool:
        return switch(name, declared.help, *flags, **more)
    if kind in (int, float):
        more = {"min": declared.least, "max": declared.most} | more
    shown = declared.shown or (None if declared.default is None else str(declared.default))
    more = {"wording": shown, "metavar": declared.metavar} | more
    return option(name, kind, more.pop("help", declared.help), *flags, **more)


def switch(name: str, help: str, *short: str, **more: Any) -> Parameter:
    """Declare a switch: an option without a value, off by default."""
    return option(name, bool, help, f"--{name.replace('_', '-')}", *short, default=False, **more)


def panel(title: str, *parameters: Parameter) -> tuple[Parameter, ...]:
    """Group options under a title in the help."""
    for parameter in parameters:
        get_args(parameter.annotation)[1].rich_help_panel = title
    return parameters


def changed(name: str, default: Any = None, **changes: Any) -> Parameter:
    """Copy a declared option with changes for one command: default, ``help``, ``show_default``, ``hidden``, ..."""
    kind, info = get_args(OPTIONS[name].annotation)
    info = copy(info)
    for attribute, value in changes.items():
        setattr(info, attribute, value)
    return OPTIONS[name].replace(default=default, annotation=Annotated[kind, info])


def _escape(help: str) -> str:
    """Escape brackets, so that rich does not take ``[ray]`` for markup, and leave out backticks."""
    return re.sub(r"\[(?=[a-z])", r"\\[", help.replace("`", ""))


def command(*parameters: str | Parameter) -> Callable[[Callable[[Args], None]], Callable[..., None]]:
    """Decorate a command with its parameters in the order of the help."""
    listed: dict[str, Parameter] = {}
    for parameter in (*parameters, "json quiet"):
        for name in parameter.split() if isinstance(parameter, str) else [parameter.name]:
            listed.setdefault(name, OPTIONS[name] if isinstance(parameter, str) else parameter)

    def decorate(function: Callable[[Args], None]) -> Callable[..., None]:
        @wraps(function)
        def run(**values: Any) -> None:
            plain = {name: value.value if isinstance(value, Enum) else value for name, value in values.items()}
            args = Args(**plain)
            with opening_line(quiet=args.silent):
                from gsmerge.runtime.memory import keep_memory

                keep_memory()
                function(args)

        run.__signature__ = Signature(list(listed.values()))  # type: ignore[attr-defined]
        run.__annotations__ = {}
        run.kinds = getattr(get_args(listed["set"].annotation)[1], "kinds", ()) if "set" in listed else ()  # type: ignore[attr-defined]
        return run

    return decorate


def call(function: Callable[..., None], **values: Any) -> None:
    """Run another command with some of its parameters; the others have their defaults."""
    declared: Signature = function.__signature__  # type: ignore[attr-defined]
    function(**{name: parameter.default for name, parameter in declared.parameters.items()} | values)


def settings_option(*kinds: type | LazyFunction, help: str = "Any other setting, such as {}; may be repeated. --set "
                    "help lists them all.", example: str = "match=aabb") -> Parameter:  # fmt: skip
    """Declare ``--set`` of a command for settings of ``kinds``, which ``--set help`` lists; heavy ones are lazy."""

    def show(values: list[str] | None) -> list[str] | None:
        if LIST not in (values or ()):
            return values
        print("\n".join(_settings_lines(listed_settings(kinds))))
        raise typer.Exit

    return changed("set", help=help.format(example), callback=show, is_eager=True, kinds=kinds)


def listed_settings(kinds: Iterable[type | LazyFunction]) -> dict[str, Setting]:
    """List the settings of a command's ``--set`` by name."""
    loaded = (kind.load() if isinstance(kind, LazyFunction) else kind for kind in kinds)
    return {name: declared for kind in loaded for name, declared in flat_settings(kind).items()}


def _settings_lines(settings: Mapping[str, Setting]) -> list[str]:
    """Write each setting with its default, and what it does, for a terminal."""
    width, lines = max(40, shutil.get_terminal_size().columns), list[str]()
    for name, declared in settings.items():
        default = declared.default
        shown = default if isinstance(default, str) else json.dumps(default, default=str)
        if isinstance(default, tuple):
            shown = ",".join(map(str, default))
        lines += [f"{name}={shown}", *textwrap.wrap(declared.help, width, initial_indent="    ",
                  subsequent_indent="    ")]  # fmt: skip
    return lines


def share_list(text: str) -> list[str]:
    """Parse shares with commas between: "1,4.4%" -> ["1%", "4.4%"]."""
    shares = [f"{part.strip().removesuffix('%')}%" for part in text.split(",")]
    try:
        numbers = [parse_share(share) for share in shares]
    except ValueError:
        numbers = []
    if len(set(numbers)) < len(shares):
        raise typer.BadParameter(f"expected different shares in %, such as 1,2,4.4,10, got {text!r}")
    return shares


def named_or_none(text: str) -> Path | str:
    """Parse ``--cameras``, ``--images`` and ``--masks``: a path, or the word none; ./none is a path."""
    return text if text == NONE else Path(text)


def number_or_text(text: str) -> int | str:
    """Parse ``--k``: a number, or a word such as "auto"."""
    return int(text) if text.isdecimal() else text


BEFORE = argument("before", Path, "BEFORE", "The scene: a .ply or its folder.")
AFTER = argument(
    "after", list[Path] | None, "[AFTER]...", "Compact files of it: .ply, .spz, .sog, .splat or .glb.", default=None
)
SCENE = argument("scene", Path, "SCENE", "A .ply with one Gaussian per pixel and view, or the folder it is in.")

# What commands share: a text, and names of options
COMPACT_SCENE = "The compact scene: .ply, .spz, .sog, .splat, .glb, .usdc or .usdz, by its name."
READING = "cameras images hint"
TARGETS = "targets target_images"

_TABLE = (
    panel(
        INPUT,
        option("cameras", Path, "Camera file or COLMAP folder: transforms.json, cameras.json, results.npz, ... "
               "Default: beside the .ply; none: without.", parser=named_or_none),
        option("images", Path, "Folder of the input photos. Default: beside the .ply; none: without.",
               parser=named_or_none),
        option("masks", Path, "Folder of images named as the photos, dark where a photo does not count. Default: masks "
               "beside the photos, and where these are transparent; none: without.", parser=named_or_none),
        option("protect", Path, "Folder of images named as the photos, white where a text or face has to stay sharp: "
               "it counts four times.", parser=named_or_none),
        option("hint", list[str], "How to read the file, where it is recognised wrongly: "
               f"{join_words(flat_settings(FileHints))}, such as order=none; may be repeated.", metavar="NAME=VALUE"),
        option("targets", Path, "Cameras of held-out photos, in any camera file; views that the scene was made from "
               "are left out."),
        option("target_images", Path, "Folder of the held-out photos. Default: beside their cameras."),
        option("sizes", str, "Also compact BEFORE to these shares of its Gaussians, in %, such as 1,2,4.4,10: the page "
               "has a slider over all sizes.", metavar="LIST", parser=share_list),
    ),
    panel(
        COUNT,
        setting_option("k", parser=number_or_text),
        setting_option("budget"),
        setting_option("quality"),
        setting_option("levels", wording="1, or 3 in a lod-meta.json"),
    ),
    panel(
        METHOD,
        *map(setting_option, ("effort", "fit")),
        option("set", list[str], "Any other setting; may be repeated.", metavar="NAME=VALUE"),
    ),
    panel(
        MEASURING,
        option("lpips", ("both", *NETS, "none"), SETTINGS["lpips"].help, wording="alex, where installed"),
    ),
    panel(
        OUTPUT,
        setting_option("crop"),
        setting_option("drop"),
        *map(setting_option, ("up", "scale", "rotate", "translate", "sh_degree")),
        option("output", Path, "", "--output", "-o"),
        switch("overwrite", "Replace the output if it exists."),
        switch("strict", "Exit with code 4, once all is written, where a result shows the scene's own photos worse "
               "than the input does, by more than .5 dB, or cameras or photos do not fit."),
        switch("dry_run", "Print what would be done; write nothing."),
        option("open", bool, "Open the page in the browser.", "--open/--no-open", default=True),
        switch("json", "Print JSON on stdout."),
    ),
    panel(
        "Running",
        setting_option("engine", default="local", wording=None),
    ),
    panel(
        GENERAL,
        setting_option("seed"),
        setting_option("threads"),
        switch("quiet", "Print errors only.", "-q"),
    ),
)  # fmt: skip
OPTIONS = {parameter.name: parameter for parameters in _TABLE for parameter in parameters}


def output(help: str, wording: str | None = None, default: Any = None) -> Parameter:
    """Declare ``-o/--output`` of a command, a file or a folder; ``default`` may be REQUIRED."""
    return changed("output", default, help=help, show_default=wording or default is not REQUIRED)
