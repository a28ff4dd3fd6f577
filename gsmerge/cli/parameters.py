"""Declare the options of the command line, each once, and turn their values into settings.

A command is a function of one :class:`Args`. The decorator :func:`command` lists the parameters of a command for Typer:
names of options that are declared here, and declarations of options that only one command has. An option for a setting
of the library has the setting's name and no default. The setting gives its help, its values and the default that the
help shows (:func:`setting_option`).
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
from dataclasses import dataclass, replace
from functools import partial, wraps
from inspect import Parameter, Signature
from pathlib import Path
from time import perf_counter
from types import NoneType, SimpleNamespace, UnionType
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import typer

from gsmerge.errors import UsageError
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import NETS, EvaluateOptions
from gsmerge.settings.placement import PlacementOptions
from gsmerge.settings.reading import NONE, FileHints, OpacityChoice, ReadHints
from gsmerge.settings.setting import Setting, change_settings, flat_settings, join_words, suggest_name
from gsmerge.settings.stages import Engine

if TYPE_CHECKING:
    from gsmerge.io.scene_files import SceneFiles
    from gsmerge.scene.read import Loaded

INPUT_GROUP, COUNT_GROUP, METHOD_GROUP, MEASURING_GROUP, OUTPUT_GROUP, GENERAL_GROUP = (
    "Input", "How many Gaussians", "Method", "Measuring", "Output", "General"
)  # fmt: skip
# Forms of plain values in the help
METAVARS = {bool: "", int: "NUMBER", float: "NUMBER", str: "TEXT", Path: "PATH", list[Path]: "PATH"}
STYLES = ("bar", "json")  # of progress
REQUIRED = Parameter.empty
LIST_SETTINGS = "help"  # with this value, --set prints all settings
SEED_VARIABLE = "GSMERGE_SEED"  # environment variable with the seed for commands without --seed

SETTINGS = {
    setting.name: setting for kind in (EvaluateOptions, Engine, PlacementOptions, CompactOptions)
    for setting in flat_settings(kind).values()
}  # fmt: skip


class Args(SimpleNamespace):
    """Values of the arguments and options of a command, by name."""

    def __init__(self, **values: Any) -> None:
        super().__init__(**values)
        self.start = perf_counter()  # when the command began

    @property
    def silent(self) -> bool:
        """True if no text is printed, but JSON or nothing."""
        return bool(self.quiet or self.json)

    def get_given(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the values of those of the named options that the user gave."""
        values = vars(self)
        return {name: values[name] for name in names if values.get(name) is not None}

    def refuse_options(self, allowed: Collection[str], path: Path) -> None:
        """Raise UsageError if the user gave an option that is not ``allowed``; ``path`` holds Feature Gaussians."""
        for name, value in self.get_given(OPTIONS).items():
            if value and name not in allowed and value != OPTIONS[name].default:
                flag = f"--{name.replace('_', '-')}"
                raise UsageError(
                    f"{flag}: expected a scene with it, but {path} holds Feature Gaussians; their number is set by --k"
                )

    def make(self, *kinds: type, **changes: Any) -> list[Any]:
        """Make an object of each class of settings in ``kinds``; UsageError if a value is wrong.

        The values come from :meth:`values`, and ``changes`` replace some of them.
        """
        values = self.values(*kinds, without=changes) | changes
        settings = [{name: values[name] for name in flat_settings(kind) if name in values} for kind in kinds]
        with usage_errors():
            return [
                kind().with_settings(arguments) if kind is CompactOptions else change_settings(kind(), arguments)
                for kind, arguments in zip(kinds, settings, strict=True)
            ]

    def values(self, *kinds: type, without: Collection[str] = ()) -> dict[str, Any]:
        """Return the values that the user gave for settings of the classes ``kinds``, by flat name.

        The values come from options, ``--set`` and the environment. Settings named in ``without`` are left out.
        """
        settings = {name: declared for name, declared in listed_settings(kinds).items() if name not in without}
        options = self.get_given(settings)
        pairs = parse_pairs("--set", vars(self).get("set") or (), settings)
        for name in options.keys() & pairs.keys():
            raise UsageError(f"--set {name}: expected this setting once, got --{name.replace('_', '-')} too")
        values = options | pairs
        # An empty variable counts as not set
        if "seed" in settings and "seed" not in values and os.environ.get(SEED_VARIABLE):
            values["seed"] = parse_value(SEED_VARIABLE, os.environ[SEED_VARIABLE], settings["seed"])
        return values

    def settings(self, **changes: Any) -> CompactOptions:
        """Make the options of :func:`gsmerge.compact`, as :meth:`make` does."""
        options: CompactOptions = self.make(CompactOptions, **changes)[0]
        return options

    @property
    def opacity(self) -> OpacityChoice:
        """How the file stores opacities, by ``--hint``; "auto" if no hint says how."""
        choice: OpacityChoice = self._parse_hints().get("opacity", "auto")
        return choice

    def hints(self, **defaults: Any) -> ReadHints:
        """Make the hints for reading the scene; UsageError for an unknown name or value in ``--hint``.

        ``defaults`` are hints that apply where the user gave none.
        """
        from gsmerge.scene.exporters import find_exporter

        values = {name: value for name, value in self._parse_hints().items() if name != "opacity"}
        with usage_errors():
            find_exporter(values.get("exporter", "auto"))
            return ReadHints(**{**defaults, **values})

    def _parse_hints(self) -> dict[str, Any]:
        return parse_pairs("--hint", self.hint or (), flat_settings(FileHints))

    def files(self, scene: Path, *more: Path) -> SceneFiles:
        """Find the .ply, cameras and photos of a scene, and of further scenes to join with it.

        Files that the user named are used, otherwise the files beside each scene.
        """
        from gsmerge.io.scene_files import find_scene_files

        named = {"cameras": self.cameras, **{name: vars(self).get(name) for name in ("images", "masks", "protect")}}
        files, *more_files = (find_scene_files(path, **named) for path in (scene, *more))
        return replace(files, more=tuple(more_files))

    def load(self, files: SceneFiles, **defaults: Any) -> Loaded:
        """Read the scene of ``files``, or return the ``loaded`` scene that another command has passed on.

        ``defaults``: hints that apply where the user gave none.
        """
        from gsmerge.scene.read import load_files

        loaded: Loaded | None = vars(self).get("loaded")
        if loaded is None or loaded.files != files:
            loaded = load_files(files, opacity=self.opacity, hints=self.hints(**defaults))
        return loaded


def parse_pairs(flag: str, pairs: Iterable[str], settings: Mapping[str, Setting]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs of ``--set`` or ``--hint``; UsageError if one is wrong, with ``flag`` in its message."""
    values: dict[str, Any] = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not sign:
            raise UsageError(f"{flag}: expected NAME=VALUE, got {pair!r}")
        if name not in settings:
            remedy = f"{flag} {LIST_SETTINGS} lists all" if flag == "--set" else f"expected {join_words(settings)}"
            raise UsageError(f"{flag} {name}: unknown{suggest_name(name, settings)}; {remedy}")
        if name in values:
            raise UsageError(f"{flag} {name}: expected it once, got it twice")
        values[name] = parse_value(f"{flag} {name}", text, settings[name])
    return values


def parse_value(label: str, text: str, declared: Setting) -> Any:
    """Parse the value of a setting or an option; UsageError if the value is not allowed.

    The error begins with ``label``. A text may have several meanings, and the first that fits the setting is taken.
    """
    candidates = _list_meanings(text)
    if declared.is_list:
        candidates.append([_list_meanings(element.strip())[0] for element in text.split(",")])
    value = next(filter(declared.fits, candidates), text)
    with usage_errors():
        replace(declared, name=label).check(value)
    return value


def _list_meanings(text: str) -> list[Any]:
    """List the possible values of a text, the best first: as JSON, as a number, and as text."""
    candidates: list[Any] = [text]
    for parse in (float, json.loads):
        with suppress(ValueError, RecursionError):
            candidates.insert(0, parse(text))
    return candidates


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turn a ValueError that the library raises in the block into a UsageError."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


@dataclass(frozen=True)
class Declaration:
    """An argument or an option of a command."""

    name: str
    kind: Any  # As Typer sees it: bool for a switch, a text for one word, a list of texts for several
    info: Any  # Typer's description
    parse: Callable[[str], Any]  # Word -> value; raises ValueError
    default: Any
    flags: tuple[str, ...] = ()  # Names of an option; empty for an argument

    @property
    def parameter(self) -> Parameter:
        """The parameter of a function that Typer calls."""
        return Parameter(
            self.name, Parameter.KEYWORD_ONLY, default=self.default, annotation=Annotated[self.kind, self.info]
        )

    def read(self, typed: Any, flags: Collection[str]) -> Any:
        """Parse the words that the user typed for this parameter.

        UsageError for a wrong word, or for one of the command's ``flags`` in place of a value.
        """
        if not isinstance(typed, str | list | tuple):  # a switch, or a default
            return typed
        label, values = self.flags[0] if self.flags else self.info.metavar.strip("[]."), list[Any]()
        for word in [typed] if isinstance(typed, str) else typed:
            if not word or (self.flags and (word == "-" or word.startswith("--") or word in flags)):
                raise UsageError(f"{label}: expected a value, got {word or 'an empty one'}")
            try:
                values.append(self.parse(word))
            except UsageError:
                raise
            except ValueError as error:
                raise UsageError(f"{label}: {error}") from error
        return values[0] if isinstance(typed, str) else values


def _declare(
    name: str, kind: Any, info: Any, parse: Callable[[str], Any] | None, default: Any, flags: tuple[str, ...] = ()
) -> Declaration:
    """Declare an argument or option.

    ``kind`` is the type of the value, ``list[...]`` for several values, or a union with None.
    """
    kind = next(part for part in get_args(kind) if part is not NoneType) if isinstance(kind, UnionType) else kind
    is_list = get_origin(kind) is list
    element_kind = get_args(kind)[0] if is_list else kind
    typer_kind = list[str] if is_list else bool if kind is bool else str
    parse = parse or (parse_path if element_kind is Path else str)
    return Declaration(name, typer_kind, info, parse, default, flags)


def argument(name: str, kind: Any, metavar: str, help: str, default: Any = REQUIRED) -> Declaration:
    """Declare a positional argument of a command."""
    return _declare(name, kind, typer.Argument(metavar=metavar, help=_escape(help)), None, default)


def option(
    name: str, kind: Any, help: str, *flags: str, default: Any = None, wording: str | None = None,
    metavar: str | None = None, parser: Callable[[str], Any] | None = None, min: float | None = None,
    max: float | None = None, **more: Any,
) -> Declaration:  # fmt: skip
    """Declare an option of a command.

    ``kind``: the type of the value; bool for a switch, or a tuple of the possible values. ``flags`` are derived from
    the name if none are given. ``wording``: words for the default that the help shows. ``more`` is passed to Typer.
    """
    flags = flags or (f"--{name.replace('_', '-')}",)
    if isinstance(kind, tuple):
        choices = list(kind)
        more["autocompletion"] = lambda: choices
        parser = partial(parse_value, flags[0], declared=Setting(help, choices=kind, kind=str))
        metavar, kind = "|".join(kind), str
    elif kind in (int, float):
        parser = partial(parse_value, flags[0], declared=Setting(help, kind=kind, least=min, most=max))
    shown = wording or default is not False
    metavar = METAVARS.get(kind) if metavar is None else metavar
    info = typer.Option(*flags, help=_escape(help), metavar=metavar, show_default=shown, **more)
    return _declare(name, kind, info, parser, default, flags)


def setting_option(
    name: str, *flags: str, metavar: str | None = None, wording: str | None = None, **more: Any
) -> Declaration:
    """Declare an option for a setting of the library, which has its help and its possible values.

    ``more`` is passed to :func:`option`.
    """
    declared = SETTINGS[name]
    flags = flags or (f"--{name.replace('_', '-')}",)
    kinds = [kind for kind in declared.kinds if kind is not NoneType]
    metavar = metavar or (METAVARS[kinds[0]] if kinds else "|".join(declared.words))
    wording = wording or (None if declared.default is None else str(declared.default))
    more = {"parser": partial(parse_value, flags[0], declared=declared)} | more
    return option(name, str, declared.help, *flags, metavar=metavar, wording=wording, **more)


def switch(name: str, help: str, *short: str, **more: Any) -> Declaration:
    """Declare a switch: an option without a value, off by default."""
    return option(name, bool, help, f"--{name.replace('_', '-')}", *short, default=False, **more)


def panel(title: str, *parameters: Declaration) -> tuple[Declaration, ...]:
    """Group options under a title in the help."""
    for parameter in parameters:
        parameter.info.rich_help_panel = title
    return parameters


def change_option(name: str, default: Any = None, **changes: Any) -> Declaration:
    """Copy a declared option for one command, with another default and other ``changes`` of Typer's description."""
    info = copy(OPTIONS[name].info)
    vars(info).update(changes)
    return replace(OPTIONS[name], info=info, default=default)


def _escape(help: str) -> str:
    """Escape brackets, so that Rich does not take ``[ray]`` for markup, and remove backticks."""
    return re.sub(r"\[(?=[a-z])", r"\\[", help.replace("`", ""))


def command(*parameters: str | Declaration) -> Callable[[Callable[[Args], None]], Callable[..., None]]:
    """Make a decorator that turns a function of one :class:`Args` into a command that Typer can call.

    ``parameters`` are in the order of the help. A text lists the names of options that are declared here.
    """
    listed: dict[str, Declaration] = {}
    for parameter in (*parameters, "progress json quiet"):
        for name in parameter.split() if isinstance(parameter, str) else [parameter.name]:
            listed.setdefault(name, OPTIONS[name] if isinstance(parameter, str) else parameter)
    flags = {flag for declared in listed.values() for flag in declared.flags}

    def decorate(function: Callable[[Args], None]) -> Callable[..., None]:
        @wraps(function)
        def run(**typed: Any) -> None:
            """Parse what was typed for each parameter, and call the function."""
            args = Args(**{name: listed[name].read(value, flags) for name, value in typed.items()})
            from gsmerge.runtime.memory import keep_memory

            keep_memory()
            function(args)

        # Typer reads the parameters from the signature
        run.__signature__ = Signature([declared.parameter for declared in listed.values()])  # type: ignore[attr-defined]
        run.__annotations__ = {}
        run.kinds = getattr(listed["set"].info, "kinds", ()) if "set" in listed else ()  # type: ignore[attr-defined]
        return run

    return decorate


def call(function: Callable[..., None], **values: Any) -> None:
    """Run a command from another one, with ``values`` for some of its parameters and defaults for the others."""
    parameters = function.__signature__.parameters.items()  # type: ignore[attr-defined]
    function.__wrapped__(Args(**{name: one.default for name, one in parameters} | values))  # type: ignore[attr-defined]


def settings_option(*kinds: type | LazyFunction, example: str = "match=aabb") -> Declaration:
    """Declare ``--set`` for the settings of ``kinds``; a class that takes long to import is given as a LazyFunction."""

    def show(values: list[str] | None) -> list[str] | None:
        if LIST_SETTINGS not in (values or ()):
            return values
        print("\n".join(_settings_lines(listed_settings(kinds))))
        raise typer.Exit

    return change_option(
        "set",
        help=f"Any other setting, such as {example}; may be repeated. --set help lists all.",
        callback=show,
        is_eager=True,
        kinds=kinds,
    )


def listed_settings(kinds: Iterable[type | LazyFunction]) -> dict[str, Setting]:
    """Return the settings that a command's ``--set`` takes, by name."""
    loaded = (kind.load() if isinstance(kind, LazyFunction) else kind for kind in kinds)
    return {name: declared for kind in loaded for name, declared in flat_settings(kind).items()}


def _settings_lines(settings: Mapping[str, Setting]) -> list[str]:
    """Format each setting with its default and help, for a terminal."""
    width, lines = max(40, shutil.get_terminal_size().columns), list[str]()
    for name, declared in settings.items():
        default = declared.default
        shown = default if isinstance(default, str) else json.dumps(default, default=str)
        lines += [f"{name}={shown}", *textwrap.wrap(declared.help, width, initial_indent="    ",
                  subsequent_indent="    ")]  # fmt: skip
    return lines


def parse_path(word: str) -> Path:
    """Parse a path; a leading ~ is the home folder, also after a = where the shell does not expand it."""
    return Path(word).expanduser()


def named_or_none(text: str) -> Path | str:
    """Parse ``--cameras``, ``--images`` and ``--masks``: a path, or the word none; ./none is a path."""
    return text if text == NONE else parse_path(text)


BEFORE = argument("before", Path, "BEFORE", "The scene: a .ply, or the folder that holds it.")
AFTER = argument(
    "after", list[Path] | None, "[AFTER]...", "Its compact files, such as small.ply or small.spz.", default=None
)
SCENE = argument("scene", Path, "SCENE", "A .ply with one Gaussian per pixel and view, or the folder that holds it.")

# Shared by commands: a text of the help, and names of options
COMPACT_SCENE = "The compact scene; the ending sets the format, such as .ply, .spz or .sog."
READING = "cameras images hint"
TARGETS = "targets target_images"

_TABLE = (
    panel(
        INPUT_GROUP,
        option("cameras", Path, "Camera file or COLMAP folder: transforms.json, cameras.json, results.npz, ... "
               "Default: beside the .ply; none: without.", parser=named_or_none),
        option("images", Path, "Folder of the input photos. Default: beside the .ply; none: without.",
               parser=named_or_none),
        option("masks", Path, "Folder of masks with the names of the photos, dark where a photo does not count. "
               "Default: masks beside the photos, and the transparency of the photos; none: without.",
               parser=named_or_none),
        option("protect", Path, "Folder of images with the names of the photos, white where a text or a face has to "
               "stay sharp. These pixels count four times.", parser=named_or_none),
        option("hint", list[str], "How to read a file that is recognised wrongly: "
               f"{join_words(flat_settings(FileHints))}, such as order=none; may be repeated.", metavar="NAME=VALUE"),
        option("targets", Path, "Cameras of held-out photos, in any camera file. Views that the scene was made from "
               "are skipped."),
        option("target_images", Path, "Folder of the held-out photos. Default: beside their cameras."),
    ),
    panel(
        COUNT_GROUP,
        setting_option("k", metavar="1-8|mixed|auto"),
        # The budget is kept as a text, because reports and the records of batches store texts
        setting_option("budget", metavar="40000|2%|5MB|DEVICE|auto", parser=str),
        setting_option("quality", metavar="30dB|-0.2dB"),
        setting_option("levels", wording="1, or 3 in a lod-meta.json"),
    ),
    panel(
        METHOD_GROUP,
        *map(setting_option, ("effort", "fit")),
        option("set", list[str], "Any other setting; may be repeated.", metavar="NAME=VALUE"),
    ),
    panel(
        MEASURING_GROUP,
        option("lpips", ("both", *NETS, "none"), SETTINGS["lpips"].help, wording="alex, where installed"),
    ),
    panel(
        OUTPUT_GROUP,
        setting_option("crop", metavar="SHAPE"),
        setting_option("drop", metavar="floaters,sky,..."),
        *map(setting_option, ("up", "scale", "sh_degree")),
        setting_option("rotate", metavar="X,Y,Z"),
        setting_option("translate", metavar="X,Y,Z"),
        option("output", Path, "", "--output", "-o"),
        switch("overwrite", "Replace the output if it exists."),
        switch("strict", "Exit with code 4, after writing everything, if a result is doubtful: if a warning says that "
               "it is worse than the input, or that a file is incomplete, does not fit or is left out."),
        switch("dry_run", "Print what would be done, and write nothing."),
        option("open", bool, "Open the page in the browser.", "--open/--no-open", default=True),
        switch("json", "Print JSON on stdout."),
    ),
    panel(
        "Running",
        setting_option("engine", default="local"),
    ),
    panel(
        GENERAL_GROUP,
        setting_option("seed"),
        setting_option("threads", wording="all processors"),
        option("progress", STYLES, "json: print a line for each step on stderr, with the seconds left.",
               default=STYLES[0]),
        switch("quiet", "Print errors only.", "-q"),
    ),
)  # fmt: skip
OPTIONS = {parameter.name: parameter for parameters in _TABLE for parameter in parameters}


def output(help: str, wording: str | None = None, default: Any = None) -> Declaration:
    """Declare ``-o/--output`` of a command, a file or a folder; ``default`` may be REQUIRED."""
    return change_option("output", default, help=help, show_default=wording or default is not REQUIRED)
