"""Convert the plain words of a command line without Typer, whose converters import Pydantic, for 50 ms of each run.

Only values are converted for which Typer has nothing to say: texts, whole and decimal numbers in range, choices by
their full name, and paths. Everything else goes to Typer, which explains what is wrong.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_origin

_NUMBERS = {int: r"\d{1,15}", float: r"\d{1,15}(\.\d{1,15})?"}


def convert_plain_values(param: Any) -> None:
    """Let a parameter of Typer convert plain words here; versions of Typer without Pydantic convert all themselves."""
    described = getattr(param, "type_descriptor", None)
    usual = param.process_value
    if described is None or isinstance(usual, _PlainFirst):
        return
    param.process_value = _PlainFirst(param, usual, described.annotation, described.parameter_info)


class _PlainFirst:
    """A parameter's conversion of words, with Typer's own as the ``usual`` one."""

    def __init__(self, param: Any, usual: Callable[[Any, Any], Any], kind: Any, info: Any) -> None:
        self._param, self._usual, self._kind, self._info = param, usual, kind, info

    def __call__(self, ctx: Any, value: Any) -> Any:
        param = self._param
        try:
            converted = self._convert_all(value)
        except Exception:  # whatever a wrong value makes a parser raise; Typer meets it again and explains it
            return self._usual(ctx, value)
        if param.required and param.value_is_missing(converted):
            return self._usual(ctx, value)
        return converted if param.callback is None else param.callback(ctx, param, converted)

    def _convert_all(self, value: Any) -> Any:
        """Convert a parameter's word or words; errors if only Typer can."""
        if not (self._param.multiple or self._param.nargs == -1):
            return None if value is None else self._convert(self._kind, value)
        if get_origin(self._kind) is not list or isinstance(value, str):
            raise TypeError("expected several words")
        return () if value is None else [self._convert(get_args(self._kind)[0], word) for word in value]

    def _convert(self, kind: Any, word: Any) -> Any:
        """Convert a word to a kind of value; errors if only Typer can."""
        info = self._info
        if info.parser is not None:
            return info.parser(word)
        if isinstance(word, kind) and not (kind is int and isinstance(word, bool)):
            return word
        if not isinstance(word, str):
            raise TypeError("expected a word")
        if kind in _NUMBERS and re.fullmatch(_NUMBERS[kind], word, re.ASCII):
            number = kind(word)
            if (info.min is None or info.min <= number) and (info.max is None or number <= info.max):
                return number
        elif kind is Path and not (info.exists or info.resolve_path or info.writable):
            if info.file_okay and info.dir_okay and (os.access(word, os.R_OK) or not os.path.lexists(word)):
                return Path(word)
        elif issubclass(kind, Enum):
            return kind(word)
        raise ValueError("expected another word")
