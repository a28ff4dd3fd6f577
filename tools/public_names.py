"""Record what is public in a release, so that a test can tell if it has changed since.

python tools/public_names.py  # writes tests/contract/released.json, as step 1 of a release

Public are the commands with their options, settings and hints, the names of the library with their arguments, exit
codes, and numbers of schemas.
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import typer.main

import gsmerge
from gsmerge import errors, integrations
from gsmerge.cli.app import app
from gsmerge.io.formats import gsm
from gsmerge.method.networks import checkpoint
from gsmerge.runtime import documents
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.files import FileOptions, PlacementOptions
from gsmerge.settings.reading import FileHints
from gsmerge.settings.setting import flat_settings

RECORD = Path(__file__).parents[1] / "tests/contract/released.json"
OPTIONS = (CompactOptions, EvaluateOptions, ExtendOptions, PlacementOptions, FileOptions, FileHints)


def public_names() -> dict[str, Any]:
    """Collect all that is public now, by kind."""
    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    research = commands["lab"].commands
    every = {name: command for name, command in commands.items() if name != "lab"}
    every |= {f"lab {name}": command for name, command in research.items()}
    return {
        "schemas": {".gsm": gsm.SCHEMA, "checkpoint": checkpoint.SCHEMA, "document": documents.SCHEMA_VERSION},
        "exit codes": {
            name: kind.exit_code
            for name, kind in vars(errors).items()
            if isinstance(kind, type) and issubclass(kind, errors.GsmergeError)
        },
        "commands": {name: _options_of(command) for name, command in sorted(every.items())},
        "settings": {options.__name__: sorted(flat_settings(options)) for options in OPTIONS},
        "python": _arguments_of(gsmerge, gsmerge.__all__),
        "integrations": _arguments_of(integrations, _functions_of(integrations)),
    }


def _options_of(command: Any) -> list[str]:
    """List the names of a command's options and arguments."""
    return sorted({word for parameter in command.params for word in (*parameter.opts, *parameter.secondary_opts)})


def _functions_of(module: ModuleType) -> list[str]:
    """List the public functions that a module defines."""
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
    return sorted(name for name in own if not name.startswith("_"))


def _arguments_of(module: ModuleType, names: list[str]) -> dict[str, list[str]]:
    """List the arguments of functions, of classes, and of their public methods."""
    arguments = dict[str, list[str]]()
    for name in sorted(set(names) - {"__version__"}):
        value = getattr(module, name)
        methods = {
            f"{name}.{method}": getattr(value, method)
            for method, one in (sorted(vars(value).items()) if isinstance(value, type) else ())
            if not method.startswith("_") and callable(getattr(value, method)) and not isinstance(one, type)
        }
        is_error = isinstance(value, type) and issubclass(value, Exception)
        for place, function in {**({} if is_error else {name: value}), **methods}.items():
            arguments[place] = list(inspect.signature(function).parameters)
    return arguments


if __name__ == "__main__":
    record = {"version": gsmerge.__version__, **public_names()}
    RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(f"{RECORD}: version {gsmerge.__version__}")
