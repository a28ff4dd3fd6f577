"""Writes the pages of docs/reference that are made from the program itself.

python docs/generate_reference.py          # write the pages that differ
python docs/generate_reference.py --check  # name them, exit code 1 if there are any; write nothing
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import typer.main
from api_page import api_page

REFERENCE = Path(__file__).parent / "reference"
COMMANDS, SETTINGS, API = "commands.md", "settings.md", "api.md"
EXPORTERS, FORMATS = "exporters.md", "formats.md"  # whose prose is written by hand, and whose tables are made
NOTICE = "<!-- Made by docs/generate_reference.py from the program: change the help there and run it again. -->"
COMMANDS_HEAD = """# Commands

`gsmerge COMMAND --help` prints the same; what is in brackets is the default. `gsmerge SCENE` takes the options of
`compact`, and opens the page of `view`. If no `--threads` or `--seed` is given, `GSMERGE_THREADS` and
`GSMERGE_SEED` of the environment are read, the seed by commands that choose at random. [Exit codes](exit-codes.md)."""
SETTINGS_HEAD = """# Settings

`compact`, `batch`, `extend` and `lab stress` take them as `--set NAME=VALUE`, such as `--set poses=fixed`; in Python
they are arguments of `gsmerge.compact`, and `help(gsmerge.CompactOptions)` says more. `--set help` lists those of a
command. In brackets: default, possible values. [Options](commands.md#gsmerge-compact) of `compact` are settings too."""


def main() -> int:
    """Write the pages, or name those that are stale."""
    stale = {name: text for name, text in make_pages().items() if not _same(REFERENCE / name, text)}
    for name, text in stale.items():
        print(os.path.normpath(f"docs/reference/{name}"))
        if "--check" not in sys.argv[1:]:
            (REFERENCE / name).write_text(text, encoding="utf-8")
    return 1 if stale and "--check" in sys.argv[1:] else 0


def _same(path: Path, text: str) -> bool:
    return path.is_file() and path.read_text(encoding="utf-8") == text


def make_pages() -> dict[str, str]:
    """Every generated page by its path below docs/reference."""
    return {
        COMMANDS: _commands_page(),
        SETTINGS: _settings_page(),
        API: f"{NOTICE}\n\n{api_page()}",
        EXPORTERS: _exporters_page((REFERENCE / EXPORTERS).read_text(encoding="utf-8")),
        FORMATS: _formats_page((REFERENCE / FORMATS).read_text(encoding="utf-8")),
    }


def _all_commands() -> dict[str, Any]:
    """Every command by its name; those of a group by both names, such as "lab chart"."""
    from gsmerge.cli.app import app

    commands: dict[str, Any] = {}
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        if command.hidden:
            continue
        inner = getattr(command, "commands", None)
        commands |= {name: command} if inner is None else {f"{name} {last}": one for last, one in inner.items()}
    return commands


def _commands_page() -> str:
    """Arguments and options of every command; what an earlier command has in the same words is only named."""
    known: dict[tuple[str, str], str] = {}
    lines = [NOTICE, "", COMMANDS_HEAD]
    for name, command in _all_commands().items():
        lines += ["", f"## gsmerge {name}", "", " ".join(command.help.split()), ""]
        same: dict[str, list[str]] = {}
        for one in (*_arguments(command), *_options(command)):
            words = "" if one.name == "set" else one.help  # --set differs only in its example
            owner = known.setdefault((one.name, words), name)
            if owner == name:
                lines.append(_entry(one))
            else:
                same.setdefault(owner, []).append(f"`{_name(one)}`")
        lines += [
            f"- as [{owner}](#gsmerge-{owner.replace(' ', '-')}): {', '.join(names)}" for owner, names in same.items()
        ]
    return "\n".join([*lines, ""])


def _arguments(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "argument"]


def _options(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "option" and p.name not in ("help", "help_all")]


def _name(param: Any) -> str:
    return str(param.opts[0] if param.param_type_name == "option" else param.metavar or param.name.upper())


def _entry(param: Any) -> str:
    """A line for an argument, or for an option: its names, its value, its default, and its help."""
    if param.param_type_name == "argument":
        return f"- `{_name(param)}`: {_line(param.help)}"
    named = sorted((*param.opts, *param.secondary_opts), key=lambda name: (not name.startswith("--"), name))
    value = "" if param.is_flag else f" {_value(param)}"
    default = _line(_default(param))
    return f"- `{', '.join(named)}{value}`{f' ({default})' if default else ''}: {_line(param.help)}"


def _value(param: Any) -> str:
    """What an option takes, as a word in capitals or a list of words."""
    return _line(param.metavar)


def _default(param: Any) -> str:
    """The default as help words it; empty where there is none, or where it says nothing, as of a switch."""
    if isinstance(param.show_default, str):
        return str(param.show_default)
    value = param.default
    if not param.show_default or param.required or value is None or value is False or callable(value):
        return ""
    return "on" if value is True else str(value)


def _line(text: str | None) -> str:
    """Text in one line, without markup of rich."""
    return " ".join((text or "").split()).replace("\\[", "[")


def _cell(text: str | None) -> str:
    """Text for a table: one line, no column separators."""
    return _line(text).replace("|", "\\|")


def _settings_page() -> str:
    from gsmerge.settings.compact import CompactOptions
    from gsmerge.settings.extend import ExtendOptions
    from gsmerge.settings.files import FileOptions
    from gsmerge.settings.placement import PlacementOptions
    from gsmerge.settings.reading import FileHints
    from gsmerge.settings.setting import flat_settings, settings_of

    whole = settings_of(CompactOptions)
    stages = {name: list(flat_settings(one.kind).values()) for name, one in whole.items() if one.is_group}
    tables = {
        "How many Gaussians": stages["budget"] + stages["blocks"] + stages["decode"],
        "Superpixels": stages["segment"],
        "Merging across views": stages["match"],
        "Fit": stages["fit"],
        "Before and after": stages["prepare"] + stages["clean"],
        "The whole run": [one for name, one in whole.items() if name not in stages],
        "Files": list(flat_settings(FileOptions).values()),
        "gsmerge convert": list(flat_settings(PlacementOptions).values()),
        "gsmerge extend": list(flat_settings(ExtendOptions).values()),
    }
    commands = _all_commands()
    options = {p.name for name in ("compact", "convert") for p in _options(commands[name])}
    lines = [NOTICE, "", SETTINGS_HEAD]
    for title, settings in tables.items():
        rest = [one for one in settings if one.name not in options]
        lines += ["", f"## {title}", "", *_list(rest)] if rest else []
    lines += ["", "## Hints", "", "`--hint NAME=VALUE` says how to read a file that is recognised wrongly.", ""]
    return "\n".join([*lines, *_list(flat_settings(FileHints).values()), ""])


def _exporters_page(page: str) -> str:
    """Renew the list of a page: what lies between the comment that names it and the one that ends it."""
    from gsmerge.scene.exporters import EXPORTERS

    results: dict[str, list[str]] = {}
    for one in EXPORTERS.values():
        for model in one.models:
            output = model.output.partition(";")[0].replace("no cameras", "")
            facts = "; ".join(filter(None, (f"`{one.name}`", output)))
            results.setdefault(model.result, []).append(f"{model.title} ({facts})")
    return _renew(page, "models", [f"- *{result}*: {'; '.join(models)}" for result, models in results.items()])


def _formats_page(page: str) -> str:
    """Renew the tables of formats, of Gaussians and of cameras."""
    from gsmerge.io.cameras.table import CAMERA_FORMATS
    from gsmerge.io.formats.table import FORMATS as ROWS

    rows = [
        (f"`{row.ending}`", "no" if row.read is None else "yes",
         f"to degree {row.max_degree}" if row.max_degree >= 0 else "no",
         " / ".join(f"{row.each[i]:.0f}" for i in (0, 3) if i < len(row.each)), row.about)
        for row in ROWS
    ]  # fmt: skip
    page = _renew(page, "formats", _rows(("name", "read", "written", "bytes", "what it is"), rows))
    cameras = (f"- {row.files}: {' '.join(row.convention)}; {row.intrinsics}" for row in CAMERA_FORMATS)
    return _renew(page, "cameras", list(cameras))


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    lines = ["| " + " | ".join(map(_cell, row)) + " |" for row in (head, *rows)]
    return [lines[0], "|---" * len(head) + "|", *lines[1:]]


def _renew(page: str, name: str, lines: Sequence[str]) -> str:
    start, end = f"<!-- {name}: made by docs/generate_reference.py from the program -->\n", "\n<!-- end -->"
    before, _, rest = page.partition(start)
    _, found, after = rest.partition(end)
    if not found:
        raise ValueError(f"expected {name!r} between {start.strip()} and {end.strip()}")
    return before + start + "\n".join(["", *lines, ""]) + end + after


def _list(settings: Iterable[Any]) -> list[str]:
    """A line for each setting: name, default, values, and what it is."""
    lines = []
    for one in settings:
        default = "" if one.default is None or one.is_group else f"`{_plain(one.default)}`"
        facts = "; ".join(filter(None, (default, _line(one.values()) if one.words else "")))
        text = _line(one.text)
        lines.append(f"- `{one.name}`{f' ({facts})' if facts else ''}: {text}")
    return lines


def _plain(value: Any) -> Any:
    """A value as TOML or JSON has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return list(value) if isinstance(value, tuple) else f"{value:.3g}" if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
