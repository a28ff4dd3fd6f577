"""Declare the parameters that several commands have, and make settings of what the user typed.

A command is a function, and Typer reads its parameters. Values of settings stay texts until :class:`Given` makes the
settings of the library of them, which check them.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass
from gsmerge.runtime.arguments import expand_home
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import NETS, EvaluateOptions
from gsmerge.settings.files import PlacementOptions
from gsmerge.settings.reading import NONE, FileHints, OpacityChoice, ReadHints
from gsmerge.settings.setting import Setting, flat_settings, join_words, suggest_name
from gsmerge.settings.stages import Engine

INPUT = "Input"
COUNT = "How many Gaussians"
METHOD = "Method"
MEASURING = "Measuring"
OUTPUT = "Output"
RUNNING = "Running"
GENERAL = "General"
LIST_SETTINGS = "help"  # with this value, --set prints all settings
SEED_VARIABLE = "GSMERGE_SEED"  # environment variable with the seed for commands without --seed
if TYPE_CHECKING:
    Parsed = Any  # a value that the ``read`` of an option has parsed
else:
    Parsed = str  # which Typer sees as a text
Kind = type | LazyFunction  # of settings; a class that takes long to import is given as a LazyFunction


def listed_settings(kinds: Iterable[Kind]) -> dict[str, Setting]:
    """Return the settings of several classes by name."""
    loaded = (kind.load() if isinstance(kind, LazyFunction) else kind for kind in kinds)
    return {name: declared for kind in loaded for name, declared in flat_settings(kind).items()}


SETTINGS = listed_settings((EvaluateOptions, Engine, PlacementOptions, CompactOptions))


@dataclass(frozen=True)
class Given:
    """Settings that the user gave by options, ``--set`` and the environment."""

    values: dict[str, Any]
    labels: dict[str, str]  # what the user typed for each, such as "--k" or "--set match"

    def make(self, *kinds: Any, **changes: Any) -> list[Any]:
        """Make an object of each class of settings; UsageError if a value is wrong. ``changes`` are further values."""
        values = self.values | changes
        with self.usage_errors():
            own = [{name: values[name] for name in flat_settings(kind) if name in values} for kind in kinds]
            return [kind().with_settings(settings) for kind, settings in zip(kinds, own, strict=True)]

    @contextmanager
    def usage_errors(self) -> Iterator[None]:
        """Turn a ValueError about a setting into a UsageError that begins with what the user typed."""
        try:
            yield
        except ValueError as error:
            name, colon, problem = str(error).partition(":")
            raise UsageError(f"{self.labels.get(name, name)}{colon}{problem}") from error


def read_settings(kinds: Sequence[Kind], pairs: Iterable[str] | None = None, **texts: str | None) -> Given:
    """Read settings from the ``texts`` of options and the ``pairs`` of ``--set``; both may be missing."""
    settings = listed_settings(kinds)
    typed = {name: text for name, text in texts.items() if text is not None}
    labels = {name: f"--{name.replace('_', '-')}" for name in typed}
    for name, text in split_pairs("--set", pairs or (), settings).items():
        if name in typed:
            raise UsageError(f"--set {name}: expected this setting once, got {labels[name]} too")
        typed[name], labels[name] = text, f"--set {name}"
    if "seed" in settings and "seed" not in typed and os.environ.get(SEED_VARIABLE):
        typed["seed"] = os.environ[SEED_VARIABLE]
        labels["seed"] = SEED_VARIABLE
    return Given({name: settings[name].parse(text) for name, text in typed.items()}, labels)


def split_pairs(flag: str, pairs: Iterable[str], known: Mapping[str, Setting]) -> dict[str, str]:
    """Split NAME=VALUE pairs of ``--set`` or ``--hint``; UsageError for a name that is not known or is repeated."""
    texts: dict[str, str] = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not sign:
            values = f"; {name} is {known[name].values()}" if name in known else ""
            raise UsageError(f"{flag}: expected NAME=VALUE, got {pair!r}{values}")
        if name not in known:
            remedy = f"{flag} {LIST_SETTINGS} lists all" if flag == "--set" else f"expected {join_words(known)}"
            raise UsageError(f"{flag} {name}: unknown{suggest_name(name, known)}; {remedy}")
        if name in texts:
            raise UsageError(f"{flag} {name}: expected it once, got it twice")
        texts[name] = text
    return texts


class Reading(NamedTuple):
    """How to read the file of a scene."""

    opacity: OpacityChoice = "auto"
    hints: ReadHints = ReadHints()


def read_hints(pairs: Iterable[str] | None, **defaults: Any) -> Reading:
    """Read ``--hint``: how the file stores opacities, and how to read the scene. ``defaults`` are other hints."""
    from gsmerge.reading.exporters import find_exporter

    declared = flat_settings(FileHints)
    texts = split_pairs("--hint", pairs or (), declared)
    values = {name: declared[name].parse(text) for name, text in texts.items()}
    given = Given(defaults | values, {name: f"--hint {name}" for name in texts})
    with given.usage_errors():
        find_exporter(values.get("exporter", "auto"))
    made, hints = given.make(FileHints, ReadHints)
    return Reading(made.opacity, hints)


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turn a ValueError that the library raises in the block into a UsageError."""
    with Given({}, {}).usage_errors():
        yield


def read_path(value: Any) -> Path | None:
    """Read the path of a parameter; a leading ~ is the home folder, also where the shell keeps it."""
    return None if value is None else Path(expand_home(value))


def read_paths(value: Any) -> list[Path]:
    """Read the paths of a parameter that takes several."""
    return [Path(expand_home(word)) for word in value or ()]


def path_or_none(value: Any) -> Any:
    """Read ``--cameras``, ``--images`` and ``--masks``: a path, or the word none; ./none is a path."""
    return value if value == NONE else read_path(value)


def reader(parse: Callable[[str], Any]) -> Callable[[Any], Any]:
    """Return a function for Typer that parses the text of an option; a ValueError of ``parse`` is wrong usage."""

    def read(value: str | None) -> Any:
        try:
            return None if value is None else parse(value)
        except ValueError as error:
            raise typer.BadParameter(str(error).removeprefix(": ")) from error

    return read


def use_threads(context: typer.Context, value: str | None) -> Any:
    """Read ``--threads`` of a command that has no settings of a run, and let the command use so many threads."""
    if value is None:
        return None
    with Given({}, {"threads": "--threads"}).usage_errors():
        count = SETTINGS["threads"].read(value)
    from gsmerge.runtime.threads import default_threads

    context.with_resource(default_threads(count))
    return count


def argument(metavar: str, help: str, read: Callable[..., Any] | None = read_paths) -> Any:
    """Describe an argument, by default several paths."""
    return typer.Argument(metavar=metavar, help=_plain(help), callback=read, show_default=False)


def option(
    panel: str, metavar: str, help: str, *flags: str, default: object = "", read: Callable[..., Any] | None = None,
    **more: Any,
) -> Any:  # fmt: skip
    """Describe an option: its panel of the help, the form of a value ("" for a switch), its help and its default."""
    shown = _plain(help) + (rf" \[default: {default}]" if default != "" else "")
    return typer.Option(
        *flags, metavar=metavar, help=shown, rich_help_panel=panel, show_default=False, show_envvar=False,
        callback=read, **more,
    )  # fmt: skip


def setting_option(panel: str, metavar: str, name: str, default: object = "") -> Any:
    """Describe an option for a setting of the library, which has its help and its default."""
    declared = SETTINGS[name]
    usual = "" if declared.default is None else declared.default
    return option(panel, metavar, declared.help, default=default or usual)


def output(help: str, default: str = "", read: Callable[..., Any] = read_path) -> Any:
    """Describe ``-o/--output`` of a command, a file or a folder."""
    return option(OUTPUT, "PATH", help, "--output", "-o", default=default, read=read)


def choice(panel: str, words: Sequence[str], help: str, default: str) -> Any:
    """Describe an option with a few possible words."""
    read = reader(Setting(help, choices=words, kind=str).read)
    return option(panel, "|".join(words), help, default=default, read=read, autocompletion=lambda: list(words))


def settings_option(kinds: Sequence[Kind], example: str = "match=aabb") -> Any:
    """Describe ``--set`` for the settings of several classes; with the value "help" it prints them."""

    def show(value: Any) -> Any:
        if LIST_SETTINGS not in (value or ()):
            return value or []
        width = max(40, shutil.get_terminal_size().columns)
        lines = list[str]()
        for name, declared in listed_settings(kinds).items():
            default = declared.default
            shown = default if isinstance(default, str) else json.dumps(default, default=str)
            lines += [f"{name}={shown}", *textwrap.wrap(declared.help, width, initial_indent="    ",
                      subsequent_indent="    ")]  # fmt: skip
        print("\n".join(lines))
        raise typer.Exit

    show.kinds = kinds  # type: ignore[attr-defined]  # for suggestions
    help = f"Any other setting, such as {example}; may be repeated. --set help lists all."
    return option(METHOD, "NAME=VALUE", help, read=show, is_eager=True)


def _plain(help: str) -> str:
    """Escape brackets, so that Rich does not take ``[ray]`` for markup, and remove backticks."""
    return re.sub(r"\[(?=[a-z])", r"\\[", help.replace("`", ""))


Before = Annotated[Path, argument("BEFORE", "The scene: a .ply, or the folder that holds it.", read_path)]
After = Annotated[list[Path] | None, argument("[AFTER]...", "Its compact files, such as small.ply or small.spz.")]
Scene = Annotated[Path, argument("SCENE", "A .ply with one Gaussian per pixel and view, or the folder that holds it.",
    read_path)]  # fmt: skip
COMPACT_SCENE = "The compact scene; the ending sets the format, such as .ply, .spz or .sog."
Cameras = Annotated[Parsed | None, option(INPUT, "PATH", "Camera file or COLMAP folder: transforms.json, cameras.json, "
    "results.npz, ... Default: beside the .ply; none: without.", read=path_or_none)]  # fmt: skip
Images = Annotated[Parsed | None, option(INPUT, "PATH", "Folder of the input photos. Default: beside the .ply; none: "
    "without.", read=path_or_none)]  # fmt: skip
Masks = Annotated[Parsed | None, option(INPUT, "PATH", "Folder of masks with the names of the photos, dark where a "
    "photo does not count. Default: masks beside the photos, and the transparency of the photos; none: without.",
    read=path_or_none)]  # fmt: skip
Protect = Annotated[Path | None, option(INPUT, "PATH", "Folder of images with the names of the photos, white where a "
    "text or a face has to stay sharp. These pixels count four times.", read=read_path)]  # fmt: skip
Hint = Annotated[list[str] | None, option(INPUT, "NAME=VALUE", "How to read a file that is recognised wrongly: "
    f"{join_words(flat_settings(FileHints))}, such as order=none; may be repeated.")]  # fmt: skip
Targets = Annotated[Path | None, option(INPUT, "PATH", "Cameras of held-out photos, in any camera file. Views that the "
    "scene was made from are skipped.", read=read_path)]  # fmt: skip
TargetImages = Annotated[Path | None, option(INPUT, "PATH", "Folder of the held-out photos. Default: beside their "
    "cameras.", read=read_path)]  # fmt: skip
K = Annotated[str | None, setting_option(COUNT, "1-8|mixed|auto", "k")]
Budget = Annotated[str | None, setting_option(COUNT, "40000|2%|5MB|DEVICE|auto", "budget")]
Quality = Annotated[str | None, setting_option(COUNT, "30dB|-0.2dB", "quality")]
Levels = Annotated[str | None, setting_option(COUNT, "NUMBER", "levels", "1, or 3 in a lod-meta.json")]
Effort = Annotated[str | None, setting_option(METHOD, "draft|fast|default|best", "effort")]
Fit = Annotated[str | None, setting_option(METHOD, "full|none", "fit")]
Lpips = Annotated[str | None, choice(MEASURING, ("both", *NETS, "none"), SETTINGS["lpips"].help, "alex, where "
    "installed")]  # fmt: skip
Crop = Annotated[str | None, setting_option(OUTPUT, "SHAPE", "crop")]
Drop = Annotated[str | None, setting_option(OUTPUT, "floaters,sky,...", "drop")]
Up = Annotated[str | None, setting_option(OUTPUT, "x|-x|y|-y|z|-z", "up")]
Scale = Annotated[str | None, setting_option(OUTPUT, "NUMBER", "scale")]
Rotate = Annotated[str | None, setting_option(OUTPUT, "X,Y,Z", "rotate")]
Translate = Annotated[str | None, setting_option(OUTPUT, "X,Y,Z", "translate")]
ShDegree = Annotated[str | None, setting_option(OUTPUT, "NUMBER", "sh_degree")]
Overwrite = Annotated[bool, option(OUTPUT, "", "Replace the output if it exists.", "--overwrite")]
Strict = Annotated[bool, option(OUTPUT, "", "Exit with code 4, after writing everything, if a result is doubtful: if a "
    "warning says that it is worse than the input, or that a file is incomplete, does not fit or is left out.",
    "--strict")]  # fmt: skip
DryRun = Annotated[bool, option(OUTPUT, "", "Print what would be done, and write nothing.", "--dry-run")]
Json = Annotated[bool, option(OUTPUT, "", "Print JSON on stdout.", "--json")]
OnRay = Annotated[str | None, setting_option(RUNNING, "local|ray", "engine")]
Seed = Annotated[str | None, setting_option(GENERAL, "NUMBER", "seed")]
Threads = Annotated[str | None, setting_option(GENERAL, "NUMBER", "threads", "all processors")]
OwnThreads = Annotated[
    Parsed | None, option(GENERAL, "NUMBER", SETTINGS["threads"].help, default="all processors", read=use_threads)
]  # of commands without settings of a run
Progress = Annotated[str | None, choice(GENERAL, ("bar", "json"), "json: print a line for each step on stderr, with "
    "the seconds left.", "bar")]  # fmt: skip
Verbose = Annotated[bool, option(GENERAL, "", "Also print which cameras, photos and masks were tried, and why they are "
    "used or left out.", "--verbose", "-v")]  # fmt: skip
Quiet = Annotated[bool, option(GENERAL, "", "Print errors only.", "--quiet", "-q")]
