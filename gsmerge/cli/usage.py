"""Explain wrong usage: reject words that are not values, and suggest options and commands that exist."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from gsmerge.cli.parameters import listed_settings
from gsmerge.cli.plain_values import convert_plain_values
from gsmerge.errors import UsageError
from gsmerge.settings.reading import FileHints
from gsmerge.settings.setting import find_near_names, flat_settings, suggest_name

PROGRAM = "gsmerge"
LAB = "lab"  # group of research commands
LOOK = "look"  # compact with a page; runs if the first word is a scene instead of a command
_LEAST_SIMILARITY = 0.75  # of an unknown option and a suggestion, 0 to 1, as difflib measures it

# Names in other programs of the commands
COMMAND_SYNONYMS = {
    "compact": ("compress", "simplify", "reduce", "decimate", "optimize", "optimise", "run"),
    "convert": ("transform", "export", "join", "merge", "combine", "crop", "translate"),
    "inspect": ("info", "stats", "describe", "show", "validate", "verify", "lint", "test"),
    "evaluate": ("eval", "measure", "metrics", "score", "report"),
    "render": ("preview", "segment"),
    "view": ("viewer", "compare"),
}
# Names in other programs of the options
OPTION_SYNONYMS = {
    "overwrite": ("force", "f", "clobber", "replace", "yes", "y"),
    "output": ("o", "out", "outdir", "out_dir", "output_dir", "output_path", "outfile", "dest"),
    "quiet": ("silent", "s", "no_progress"),
    "jobs": ("j", "workers", "num_workers", "processes"),
    "images": ("photos", "image", "image_dir", "image_path"),
    "cameras": ("camera", "poses", "transforms", "colmap"),
}
# Names in other programs of an option for the format, which is here the ending of the output, and of --budget
FORMAT_WORDS = ("format", "to", "type", "ext", "extension")
BUDGET_WORDS = (
    "ratio", "percent", "percentage", "share", "fraction", "factor", "keep", "count", "num", "number", "gaussians",
    "num_gaussians", "max_gaussians", "num_points", "target_count", "size", "max_size",
)  # fmt: skip

_NO_INTEGER = "Input should be a valid integer, unable to parse string as an integer"  # words of Typer
# Typer does not export its usage errors; BadParameter, which it exports, derives from their common base
UsageErrors: Any = typer.BadParameter.__mro__[2]


def expand_home(word: str) -> str:
    """Expand a leading ~ in a word, also after a short option or after a =, where the shell has not done it."""
    match = re.fullmatch(r"(-\w|.*?=|)(~.*)", word, re.DOTALL)
    return word if match is None else match[1] + os.path.expanduser(match[2])


class _Words:
    """Mixin of commands and groups that checks the typed words before they are parsed as values."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after a command's name; raise UsageError for empty, missing and repeated values."""
        words = list(args)
        params = self.get_params(ctx)  # type: ignore[attr-defined]
        names = {name for param in params for name in param.opts}
        for param in params:
            convert_plain_values(param)
        first = words[0] if words and hasattr(self, "commands") else ""
        if re.match("-[^-]{2}", first) and _owner({first[1:].partition("=")[0].replace("-", "_")}, self):
            raise UsageError(f"{first}: expected two dashes, -{first}, after the name of a command or scene")
        for word in words[: words.index("--") if "--" in words else None]:
            if re.match("-[^-]", word) and f"-{word.partition('=')[0]}" in names:
                raise UsageError(f"{word}: expected two dashes, -{word}")
        try:
            rest: list[str] = super().parse_args(ctx, args)  # type: ignore[misc]
        except UsageErrors as error:
            error.ctx = getattr(error, "ctx", None) or ctx  # errors of the parser have no context
            raise
        values, _, order = self.make_parser(ctx).parse_args(args=words)  # type: ignore[attr-defined]
        for param in params:
            _check_words(param, values.get(param.name), order.count(param), names)
        return rest


def _check_words(param: Any, words: Any, times: int, names: set[str]) -> None:
    """Raise UsageError if a parameter's words are not its values: an empty word, an option, or too many words."""
    is_option = param.param_type_name == "option"
    label = param.opts[0] if is_option else param.metavar or str(param.name).upper()
    words = [word for word in (words if isinstance(words, (list, tuple)) else [words]) if isinstance(word, str)]
    for i, word in enumerate(words):
        if not word:
            raise UsageError(f"{label}: expected a value, got an empty one")
        if is_option and word == "-" and param.name == "output":
            raise UsageError(f"{label}: expected a file to write, got -; results are not written to stdout")
        if is_option and (word in names or word == "-" or word.startswith("--")):
            raise UsageError(f"{label}: expected a value, got {word}")
        if is_option and word in words[:i]:
            raise UsageError(f"{label}: expected each value once, got {word} twice")
    if is_option and words and times > 1 and not param.multiple:
        raise UsageError(f"{label}: expected one value, got {times}")


class Group(_Words, TyperGroup):
    """A command with commands of its own."""


class Command(_Words, TyperCommand):
    """A command whose usage line begins with its arguments, under the names that its help uses."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """List the parts of the usage line after the name of the command."""
        pieces = []
        for param in self.params:
            if param.param_type_name == "argument":
                name = param.metavar or str(param.name).upper()
                pieces.append(f"{name}..." if param.nargs == -1 and "..." not in name else name)
        return [*pieces, "[OPTIONS]"]


def _wrong_values(error: BaseException) -> list[str]:
    """List the texts that the cause of an error could not parse; empty for another cause."""
    cause: Any = error.__cause__ or error.__context__
    return [entry["input"] for entry in cause.errors()] if hasattr(cause, "errors") else []


def usage_message(error: Any, make_command: Callable[[], Any]) -> str:
    """Describe wrong usage in one line, with a correction if one is known; ``make_command`` makes all commands."""
    path = PROGRAM if error.ctx is None else error.ctx.command_path.replace(f" {LOOK}", " compact")
    message = error.format_message().replace("Value error, ", "", 1).rstrip(".")  # Typer adds this prefix
    if _NO_INTEGER in message:
        message = message.replace(_NO_INTEGER, "expected a whole number")
        message += next((f", got {value!r}" for value in _wrong_values(error)), "")
    parameters = [] if error.ctx is None else error.ctx.command.params
    has_output = any(parameter.name == "output" for parameter in parameters)
    if hasattr(error, "possibilities") and error.ctx is not None:
        suggestion = _suggest(error.option_name, error.ctx.command, path, make_command)
        message = suggestion or f"No such option: {error.option_name}"
    elif match := re.search(r": '(.*)' is not one of (.*)", message):
        message += suggest_name(match[1], re.findall("'([^']*)'", match[2]))
    elif message.startswith("Got unexpected extra argument") and has_output:
        message += "; name the output with -o"
    elif match := re.match(r"No such command '(\w+)'", message):
        synonym = next((name for name, words in COMMAND_SYNONYMS.items() if match[1] in words), None)
        message = message if synonym is None else f"{match[0]}. Did you mean '{synonym}'?"
    return f"{message}; see '{path} --help'"


def _suggest(option: str, command: Any, path: str, make_command: Callable[[], Any]) -> str | None:
    """Suggest a replacement for an option that ``command``, called as ``path``, does not have; None if there is none.

    The suggestion is ``--set`` or ``--hint`` if a setting without an option of its own has this name. Otherwise it is
    the option that has this name in other programs, an option with a similar name, or the command that has the option.
    """
    name = option.lstrip("-").replace("-", "_")
    names = {str(parameter.name): parameter.opts[0] for parameter in command.params if parameter.opts[0][0] == "-"}
    names["help"] = "--help"
    if name in BUDGET_WORDS and "budget" in names:
        alternative = ", or --k" if "k" in names else ""
        return f"{option} is not an option: use --budget, such as 2%, 40000 or 5MB{alternative}"
    if name in flat_settings(FileHints) and "hint" in names:
        return f"{option} is not an option: use --hint {name}=VALUE"
    positive, settings = name.removeprefix("no_"), {}
    with suppress(ImportError):  # the settings of training need torch, which may not be installed
        settings = listed_settings(getattr(command.callback, "kinds", ()))
    if positive in settings:
        default = settings[positive].default
        value = str(not default).lower() if isinstance(default, bool) else "VALUE" if positive == name else "none"
        alternative = f", or --grid {positive}=A,B for several" if "grid" in names else ""
        return f"{option} is not an option: use --set {positive}={value}{alternative}"
    synonyms = [known for known, words in OPTION_SYNONYMS.items() if name in words]
    if command.name == "convert" and ("output" in synonyms or name in ("output", *FORMAT_WORDS)):
        return f"{option} is not an option: the last file is the output, as in gsmerge convert a.ply x.spz"
    if name in FORMAT_WORDS and "output" in names:
        example = ", such as -o x.spz" if command.name in ("compact", LOOK) else ""
        return f"{option} is not an option: the ending of -o sets the format{example}"
    similar = _find_similar(name, names, synonyms)
    if similar is not None and not name.startswith("no_"):
        return f"{option} is not an option: use {names[similar]}"
    owner = None if positive in names else _owner({name, positive, *synonyms}, make_command())
    if owner is not None and hasattr(command, "commands"):
        return f"{option} comes after the name of a command or scene"
    return None if owner is None else f"{option} is not an option of {path}: use {PROGRAM} {owner}"


def _find_similar(name: str, names: Collection[str], synonyms: Sequence[str]) -> str | None:
    """Return a synonym among ``names``, or else the only name that begins with ``name``, or a similar name."""
    listed = [synonym for synonym in synonyms if synonym in names]
    longer = [known for known in names if len(name) > 2 and known.startswith(name)]
    similar = listed or (longer if len(longer) == 1 else []) or find_near_names(name, names, least=_LEAST_SIMILARITY)
    return similar[0] if similar else None


def _owner(names: set[str], group: Any) -> str | None:
    """Return the first command of a group that has an option with one of these names; its own groups come last."""
    for word, command in sorted(group.commands.items(), key=lambda item: hasattr(item[1], "commands")):
        if hasattr(command, "commands"):
            inner = _owner(names, command)
            if inner is not None:
                return f"{word} {inner}"
        elif any(param.name in names and param.param_type_name == "option" for param in command.params):
            return str(word)
    return None
