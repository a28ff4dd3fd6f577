"""Explain wrong usage in one line, and keep Typer from converting the words of the command line."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from gsmerge.errors import UsageError
from gsmerge.settings.reading import FileHints
from gsmerge.settings.setting import flat_settings

PROGRAM = "gsmerge"
LAB = "lab"  # group of research commands
LOOK = "look"  # compact with a page; runs if the first word is a scene instead of a command
# Names that other programs give to options, and the different names of the same options here
SYNONYMS = {
    **dict.fromkeys(("force", "clobber", "yes"), "overwrite"),
    **dict.fromkeys(("ratio", "percent", "keep", "count", "num-gaussians"), "budget"),
    **dict.fromkeys(("format", "to", "type"), "output"),
    **dict.fromkeys(("photos", "image-dir"), "images"),
    **dict.fromkeys(("poses", "colmap"), "cameras"),
}
# Typer does not export the base of its usage errors, but exports BadParameter, which derives from it
UsageErrors: Any = typer.BadParameter.__mro__[2]


class _Words:
    """Replaces Typer's conversion, and leaves the words of a parameter as they were typed.

    Commands convert the words themselves, by the declarations of the settings. Typer's conversion imports Pydantic,
    which takes 50 ms of each run.
    """

    @staticmethod
    def coerce(value: Any, param: Any, ctx: Any) -> Any:
        """Return the words of a parameter unchanged; for a list that is missing, return an empty one as Typer does."""
        return () if value is None and (param.multiple or param.nargs == -1) else value


class _OneLine:
    """Base of our commands and groups, which explain wrong usage in one line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after a command's name; UsageError for an option with one dash, or for a repeated option."""
        params = self.get_params(ctx)  # type: ignore[attr-defined]
        flags = {flag for param in params for flag in param.opts}
        words = args[: args.index("--") if "--" in args else None]
        typed_flags = [word.partition("=")[0] for word in words]
        for param in params:
            is_single = not (param.multiple or getattr(param, "is_flag", True))
            if is_single and sum(map(typed_flags.count, param.opts)) > 1:
                raise UsageError(f"{param.opts[0]}: expected it once, got it again")
            if isinstance(getattr(param, "show_default", None), str):  # Typer would put this text into brackets twice
                param._get_default_string = lambda text=param.show_default, **_: text
        for word, flag in zip(words, typed_flags, strict=True):
            if re.match("-[^-]", word) and f"-{flag}" in flags:
                raise UsageError(f"{word}: expected two dashes, -{word}")
        is_own = isinstance(self, TyperGroup) or hasattr(self.callback, "kinds")  # type: ignore[attr-defined]
        for param in params if is_own else ():  # commands of other packages may need Typer's conversion
            param.get_runtime_param = _Words
        try:
            return super().parse_args(ctx, args)  # type: ignore[misc]
        except UsageErrors as error:
            error.ctx = getattr(error, "ctx", None) or ctx  # errors of the parser have no context
            raise


class Group(_OneLine, TyperGroup):
    """A command with subcommands."""


class Command(_OneLine, TyperCommand):
    """A command whose usage line names the arguments as its help does."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """List the parts of the usage line after the name of the command."""
        return [*(str(param.metavar) for param in self.params if param.param_type_name == "argument"), "[OPTIONS]"]


def usage_message(error: Any) -> str:
    """Describe wrong usage in one line, with a correction if one is known."""
    path = PROGRAM if error.ctx is None else error.ctx.command_path.replace(f" {LOOK}", " compact")
    message = error.format_message()
    if hasattr(error, "possibilities") and error.ctx is not None:
        suggestion = _suggest(error.option_name, error.ctx.command)
        message = f"No such option: {error.option_name}{suggestion}" if suggestion else message
    message = " ".join(message.split()).rstrip(".")
    return f"{message}; see '{path} --help'"


def _suggest(option: str, command: Any) -> str:
    """Return the end of a message: what to type instead of an unknown ``option``; empty if nothing is known."""
    from gsmerge.cli.parameters import listed_settings

    name, known = option.lstrip("-").replace("-", "_"), {param.name for param in command.params}
    settings, synonym = {}, SYNONYMS.get(option.lstrip("-"))
    with suppress(ImportError):  # the settings of training need torch, which may not be installed
        settings = listed_settings(getattr(command.callback, "kinds", ()))
    if name.removeprefix("no_") in settings:
        declared = settings[name.removeprefix("no_")]
        value = str(not declared.default).lower() if isinstance(declared.default, bool) else "VALUE"
        return f"; use --set {declared.name}={value}"
    if name in flat_settings(FileHints) and "hint" in known:
        return f"; use --hint {name}=VALUE"
    return f"; use --{synonym}" if synonym in known else ""
