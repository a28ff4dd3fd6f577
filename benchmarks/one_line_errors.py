"""Importing this lets a script that stops for a missing or wrong file say so in one line, without a traceback."""

from __future__ import annotations

import sys
from types import TracebackType

import gsmerge

CAPTURES = "docs/internals/captures.md says how captures are made, and which files are not public"


def _print_error(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, gsmerge.GsmergeError | FileNotFoundError):
        print(f"{error}; {CAPTURES}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _print_error
