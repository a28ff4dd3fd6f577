"""Explain wrong usage in one line, and keep Typer from converting the words of the command line.

Left to Typer, ``--effort fast --effort best`` takes the last value silently, ``--output=`` counts as no output,
``-effort draft`` is explained as "No such option: -e", and an option ``force`` leads to ``--effort`` in
place of ``--overwrite``. With Typer's conversion, a command also imports 87 modules more, and needs 9 MB more memory.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from gsmerge.errors import UsageError
from gsmerge.settings.reading import FileHints
from gsmerge.settings.setting import SYNONYMS, flat_settings, suggest_name

PROGRAM = "gsmerge"
LAB = "lab"  # group of research commands
# Words that users try as commands, and what does this
COMMAND_SYNONYMS = {
    **dict.fromkeys(("compress", "reduce", "simplify", "optimize", "prune", "merge", "shrink"), "compact"),
    **dict.fromkeys(("info", "stats", "check"), "inspect"),
    **dict.fromkeys(("show", "open", "preview"), "view"),
    **dict.fromkeys(("measure", "compare", "score", "metrics"), "evaluate"),
    "draw": "render",
    "export": "convert",
    "version": "--version",
}
# Typer does not export the base of its usage errors, but exports BadParameter, which derives from it
UsageErrors: Any = typer.BadParameter.__mro__[2]


class _Texts:
    """Replaces Typer's conversion of texts, which imports Pydantic; the settings convert and check them."""

    @staticmethod
    def coerce(value: Any, param: Any, ctx: Any) -> Any:
        """Return the texts of a parameter unchanged; for a list that is missing, return an empty one as Typer does."""
        return () if value is None and (param.multiple or param.nargs == -1) else value


def adapt_to_texts(params: Iterable[Any]) -> None:
    """Keep Typer from converting the values of parameters, and from showing ``<bool>`` or ``<list[str]>`` as types."""
    for param in params:
        shown = param.metavar if param.param_type_name == "option" else None
        param.get_runtime_param = _Texts
        param.display_type_rich = lambda ctx, shown=shown: shown


class Group(TyperGroup):
    """A command with subcommands."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words before the name of a subcommand."""
        adapt_to_texts(self.get_params(ctx))
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the subcommand; UsageError for an unknown one, with what may have been meant."""
        name = args[0]
        if self.get_command(ctx, name) is not None or name.startswith("-"):
            return super().resolve_command(ctx, args)
        from gsmerge.io.bounds import suggest_path

        names = self.list_commands(ctx)
        synonym = COMMAND_SYNONYMS.get(name.lower())
        hint = f"; perhaps {synonym}" if synonym else suggest_name(name, names)
        if not hint and ctx.parent is None:
            hint = f"; to compact a scene, name a file or folder that exists{suggest_path(name)}"
        raise UsageError(f"No such command '{name}'{hint}; see '{ctx.command_path} --help'")


class Command(TyperCommand):
    """A command that refuses half typed options, and whose usage line names the arguments as its help does."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after the name of the command.

        UsageError for an option with one dash, a repeated option, or an option without a value.
        """
        params: list[Any] = self.get_params(ctx)
        adapt_to_texts(params)
        flags = {flag for param in params for flag in param.opts}
        try:
            for typed in args[: args.index("--") if "--" in args else None]:
                if re.match("-[^-]", typed) and f"-{typed.partition('=')[0]}" in flags:
                    raise UsageError(f"{typed}: expected two dashes, -{typed}")
            values, _, order = self.make_parser(ctx).parse_args(list(args))
            for param in params:
                is_option = param.param_type_name == "option"
                label = param.opts[0] if is_option else str(param.metavar).strip("[].")
                if is_option and order.count(param) > 1 and not (param.multiple or param.is_flag):
                    raise UsageError(f"{label}: expected it once, got it again")
                value = values.get(param.name)
                for word in value if isinstance(value, list | tuple) else (value,):
                    is_flag = is_option and isinstance(word, str) and (word == "-" or word[:2] == "--" or word in flags)
                    if word == "" or is_flag:  # a flag in place of a value
                        raise UsageError(f"{label}: expected a value, got {word or 'an empty one'}")
            return super().parse_args(ctx, args)
        except UsageErrors as error:
            error.ctx = error.ctx or ctx  # errors of the parser have no context
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """List the parts of the usage line after the name of the command."""
        return [*(str(param.metavar) for param in self.params if param.param_type_name == "argument"), "[OPTIONS]"]


def usage_message(error: Any) -> str:
    """Describe wrong usage in one line, with a correction if one is known."""
    path = PROGRAM if error.ctx is None else error.ctx.command_path
    message = error.format_message()
    if hasattr(error, "possibilities") and error.ctx is not None:
        suggestion = _suggest(error.option_name, error.ctx.command)
        message = f"No such option: {error.option_name}{suggestion}" if suggestion else message
    message = " ".join(message.split()).rstrip(".")
    return f"{message}; see '{path} --help'"


def _suggest(option: str, command: Any) -> str:
    """Return the end of a message: what to type instead of an unknown ``option``; empty if nothing is known."""
    from gsmerge.cli.parameters import listed_settings

    name = option.lstrip("-").replace("-", "_")
    params = {param.name: param for param in command.params}
    settings = {}
    synonym = SYNONYMS.get(name)
    with suppress(ImportError):  # the settings of training need torch, which may not be installed
        settings = listed_settings(params["set"].callback.kinds) if "set" in params else {}
    if name.removeprefix("no_") in settings:
        declared = settings[name.removeprefix("no_")]
        value = str(not declared.default).lower() if isinstance(declared.default, bool) else "VALUE"
        return f"; use --set {declared.name}={value}"
    if name in flat_settings(FileHints) and "hint" in params:
        return f"; use --hint {name}=VALUE"
    return f"; use --{synonym}" if synonym in params else ""
