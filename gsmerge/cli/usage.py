"""Explain wrong usage: words that are no values, and what to type in place of what does not exist."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from gsmerge.cli.parameters import listed_settings
from gsmerge.errors import UsageError
from gsmerge.settings.reading import FileHints
from gsmerge.settings.setting import find_near_names, flat_settings, suggest_name

PROGRAM = "gsmerge"
LAB, LOOK = "lab", "look"  # the group of research commands, and compact with a page, which a scene's name alone calls
_NEAR = 0.75  # likeness of two names, as difflib measures it, from which one is taken for the other

# What other programs call a command, and the number of Gaussians
OTHER_WORDS = {
    "compact": ("compress", "simplify", "reduce", "decimate", "optimize", "optimise", "run"),
    "convert": ("transform", "export", "join", "merge", "combine", "crop", "translate"),
    "inspect": ("info", "stats", "describe", "show", "validate", "verify", "lint", "test"),
    "evaluate": ("eval", "measure", "metrics", "score", "report"),
    "render": ("preview", "segment"),
    "view": ("viewer", "compare"),
}
# What other programs call an option
OTHER_OPTIONS = {
    "overwrite": ("force", "f", "clobber", "replace", "yes", "y"),
    "output": ("o", "out", "outdir", "out_dir", "output_dir", "output_path", "outfile", "dest"),
    "quiet": ("silent", "s", "no_progress"),
    "jobs": ("j", "workers", "num_workers", "processes"),
    "images": ("photos", "image", "image_dir", "image_path"),
    "cameras": ("camera", "poses", "transforms", "colmap"),
}
FORMAT_WORDS = ("format", "to", "type", "ext", "extension")
BUDGET_WORDS = (
    "ratio", "percent", "percentage", "share", "fraction", "factor", "keep", "count", "num", "number", "gaussians",
    "num_gaussians", "max_gaussians", "num_points", "target_count", "size", "max_size",
)  # fmt: skip

# Typer does not export its usage errors; BadParameter, which it exports, derives from their common base
UsageErrors: Any = typer.BadParameter.__mro__[2]


def expand_home(word: str) -> str:
    """Write out the ~ with which a word, or what follows an option or a = in it, begins, where no shell has done so."""
    match = re.fullmatch(r"(-\w|.*?=|)(~.*)", word, re.DOTALL)
    return word if match is None else match[1] + os.path.expanduser(match[2])


class _Words:
    """Part of commands and groups: what was typed is checked as words, before it is read as values."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after a command's name; raise UsageError for empty, missing and repeated values."""
        words = list(args)
        params = self.get_params(ctx)  # type: ignore[attr-defined]
        names = {name for param in params for name in param.opts}
        for word in words[: words.index("--") if "--" in words else None]:
            if f"-{word.partition('=')[0]}" in names and not word.startswith("--"):
                raise UsageError(f"{word}: expected two dashes, -{word}")
        try:
            rest: list[str] = super().parse_args(ctx, args)  # type: ignore[misc]
        except UsageErrors as error:
            error.ctx = getattr(error, "ctx", None) or ctx  # the parser's own have none
            raise
        values, _, order = self.make_parser(ctx).parse_args(args=words)  # type: ignore[attr-defined]
        for param in params:
            _check_words(param, values.get(param.name), order.count(param), names)
        return rest


def _check_words(param: Any, words: Any, times: int, names: set[str]) -> None:
    """Raise UsageError if a parameter's words are no values: empty, the name of an option, or one too many."""
    is_option = param.param_type_name == "option"
    label = param.opts[0] if is_option else param.metavar or str(param.name).upper()
    words = [word for word in (words if isinstance(words, (list, tuple)) else [words]) if isinstance(word, str)]
    for place, word in enumerate(words):
        if not word:
            raise UsageError(f"{label}: expected a value, got an empty one")
        if is_option and word == "-" and param.name == "output":
            raise UsageError(f"{label}: expected a file to write, got -; results are not written to stdout")
        if is_option and (word in names or word == "-" or word.startswith("--")):
            raise UsageError(f"{label}: expected a value, got {word}")
        if is_option and word in words[:place]:
            raise UsageError(f"{label}: expected each value once, got {word} twice")
    if is_option and words and times > 1 and not param.multiple:
        raise UsageError(f"{label}: expected one value, got {times}")


class Group(_Words, TyperGroup):
    """A command with commands of its own."""


class Command(_Words, TyperCommand):
    """A command whose usage begins with its arguments, each as its help names it."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """List the parts of the usage line after the name of the command."""
        pieces = []
        for param in self.params:
            if param.param_type_name == "argument":
                name = param.metavar or str(param.name).upper()
                pieces.append(f"{name}..." if param.nargs == -1 and "..." not in name else name)
        return [*pieces, "[OPTIONS]"]


def usage_message(error: Any, make_command: Callable[[], Any]) -> str:
    """Describe wrong usage in one line, with the correct way to write it; ``make_command`` makes all commands."""
    place = PROGRAM if error.ctx is None else error.ctx.command_path.replace(f" {LOOK}", " compact")
    message = error.format_message().replace("Value error, ", "", 1).rstrip(".")  # a prefix of checks inside Typer
    parameters = [] if error.ctx is None else error.ctx.command.params
    has_output = any(parameter.name == "output" for parameter in parameters)
    if hasattr(error, "possibilities") and error.ctx is not None:
        suggestion = _suggest(error.option_name, error.ctx.command, place, make_command)
        message = suggestion or f"No such option: {error.option_name}"
    elif match := re.search(r": '(.*)' is not one of (.*)", message):
        message += suggest_name(match[1], re.findall("'([^']*)'", match[2]))
    elif message.startswith("Got unexpected extra argument") and has_output:
        message += "; name what is written with -o"
    elif match := re.match(r"No such command '(\w+)'", message):
        if match[1] == "help":
            return f"help is no command: use {PROGRAM} --help, or {PROGRAM} COMMAND --help"
        near = next((name for name, words in OTHER_WORDS.items() if match[1] in words), None)
        message = message if near is None else f"{match[0]}. Did you mean '{near}'?"
    return f"{message}; see '{place} --help'"


def _suggest(option: str, command: Any, place: str, make_command: Callable[[], Any]) -> str | None:
    """Suggest what to type in place of an option that ``command``, called as ``place``, lacks; None if nothing is near.

    That is ``--set`` or ``--hint`` for a setting without an option of its own, what other programs' word for it means,
    an option of nearly the same name, or the command that has it.
    """
    name = option.lstrip("-").replace("-", "_")
    names = {str(parameter.name): parameter.opts[0] for parameter in command.params if parameter.opts[0][0] == "-"}
    names["help"] = "--help"
    if name in BUDGET_WORDS and "budget" in names:
        more = ", or --k" if "k" in names else ""
        return f"{option} is no option: use --budget, such as 2%, 40000 or 5MB{more}"
    if name in flat_settings(FileHints) and "hint" in names:
        return f"{option} is no option: use --hint {name}=VALUE"
    positive, settings = name.removeprefix("no_"), {}
    with suppress(ImportError):  # training's, where torch is not installed
        settings = listed_settings(getattr(command.callback, "kinds", ()))
    if positive in settings:
        default = settings[positive].default
        value = str(not default).lower() if isinstance(default, bool) else "VALUE" if positive == name else "none"
        more = f", or --grid {positive}=A,B for several" if "grid" in names else ""
        return f"{option} is no option: use --set {positive}={value}{more}"
    same = [known for known, words in OTHER_OPTIONS.items() if name in words]
    if command.name == "convert" and ("output" in same or name in ("output", *FORMAT_WORDS)):
        return f"{option} is no option: the last file is what is written, by its name: gsmerge convert a.ply x.spz"
    if name in FORMAT_WORDS and "output" in names:
        example = ", such as -o x.spz" if command.name in ("compact", LOOK) else ""
        return f"{option} is no option: the name of -o decides{example}"
    begun = [known for known in names if len(name) > 2 and known.startswith(name)]
    near = [known for known in same if known in names] or (begun if len(begun) == 1 else [])
    near = near or find_near_names(name, names, least=_NEAR)
    if near and not name.startswith("no_"):
        return f"{option} is no option: use {names[near[0]]}"
    owner = None if positive in names else _owner({name, positive, *same}, make_command())
    if owner is not None and hasattr(command, "commands"):
        return f"{option} comes after the name of a command or scene"
    return None if owner is None else f"{option} is no option of {place}: {PROGRAM} {owner} has it"


def _owner(names: set[str], group: Any) -> str | None:
    """Name the first command of a group that has an option of one of these names; groups in it come last."""
    for word, command in sorted(group.commands.items(), key=lambda item: hasattr(item[1], "commands")):
        if hasattr(command, "commands"):
            inner = _owner(names, command)
            if inner is not None:
                return f"{word} {inner}"
        elif any(param.name in names and param.param_type_name == "option" for param in command.params):
            return str(word)
    return None
