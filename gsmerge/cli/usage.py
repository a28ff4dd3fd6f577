"""Explain wrong usage in one line, and take the words of the command line as they are typed."""

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
# Names in other programs of options whose names here resemble them too little to be found by that
SYNONYMS = {
    **dict.fromkeys(("force", "clobber", "yes"), "overwrite"),
    **dict.fromkeys(("ratio", "percent", "keep", "count", "num-gaussians"), "budget"),
    **dict.fromkeys(("format", "to", "type"), "output"),
    **dict.fromkeys(("photos", "image-dir"), "images"),
    **dict.fromkeys(("poses", "colmap"), "cameras"),
}
# Typer does not export its usage errors; BadParameter, which it exports, derives from their common base
UsageErrors: Any = typer.BadParameter.__mro__[2]


class _Words:
    """Values of a parameter, as they were typed.

    Our commands turn words into values themselves, by the declarations of the settings. Typer's own conversion imports
    Pydantic, which takes 50 ms of each run.
    """

    @staticmethod
    def coerce(value: Any, param: Any, ctx: Any) -> Any:
        """Return the words of a parameter; as Typer's converters, empty for a missing list."""
        return () if value is None and (param.multiple or param.nargs == -1) else value


class _OneLine:
    """Mixin of commands and groups whose wrong usage is explained in one line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after a command's name; UsageError for an option with one dash, or given again."""
        params = self.get_params(ctx)  # type: ignore[attr-defined]
        names = {name for param in params for name in param.opts}
        words = args[: args.index("--") if "--" in args else None]
        typed = [word.partition("=")[0] for word in words]
        for param in params:
            if not (param.multiple or getattr(param, "is_flag", True)) and sum(map(typed.count, param.opts)) > 1:
                raise UsageError(f"{param.opts[0]}: expected it once, got it again")
            if isinstance(getattr(param, "show_default", None), str):  # Typer would put brackets into its brackets
                param._get_default_string = lambda words=param.show_default, **_: words
        for word in words:
            if re.match("-[^-]", word) and f"-{word.partition('=')[0]}" in names:
                raise UsageError(f"{word}: expected two dashes, -{word}")
        if isinstance(self, TyperGroup) or hasattr(self.callback, "kinds"):  # type: ignore[attr-defined]
            for param in params:
                param.get_runtime_param = _Words
        try:
            return super().parse_args(ctx, args)  # type: ignore[misc]
        except UsageErrors as error:
            error.ctx = getattr(error, "ctx", None) or ctx  # errors of the parser have no context
            raise


class Group(_OneLine, TyperGroup):
    """A command with commands of its own."""


class Command(_OneLine, TyperCommand):
    """A command whose usage line has its arguments under the names that its help uses."""

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
    """Say how to give what an unknown option means, if it is a setting or a hint, or has another name here."""
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
