"""Small settings files: TOML or JSON tables."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError


def read_table(path: Path) -> dict[str, Any]:
    """The table of a ``.json`` file, or of any other as TOML.

    Raises:
        SceneError: If the file cannot be read or holds no table, or TOML is read on Python 3.10.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(path, "expected a TOML or JSON file, found none that can be read") from error
    try:
        table = json.loads(text) if path.suffix.lower() == ".json" else _toml(path, text)
    except (ValueError, RecursionError) as error:
        raise SceneError(path, f"expected TOML or JSON, found a mistake ({str(error).splitlines()[0]})") from error
    if not isinstance(table, dict):
        raise SceneError(path, "expected a table of settings, found no table")
    return table


def _toml(path: Path, text: str) -> Any:
    if sys.version_info >= (3, 11):
        import tomllib

        return tomllib.loads(text)
    raise SceneError(path, "TOML needs Python 3.11", "write the settings as JSON")
