"""Write the pages of docs/reference that are made from the program itself.

python docs/generate_reference.py          # write the pages that differ from the program
python docs/generate_reference.py --check  # only name these pages; the exit code is 1 if there are any
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import typer.main

REFERENCE = Path(__file__).parent / "reference"
COMMANDS, SETTINGS = "commands.md", "settings.md"
EXPORTERS, FORMATS = "exporters.md", "formats.md"  # pages whose prose is written by hand, and whose lists are made here
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
    """Write the pages that are stale, or only name them with ``--check``; return the exit code."""
    stale = {name: text for name, text in make_pages().items() if not _has_text(REFERENCE / name, text)}
    for name, text in stale.items():
        print(os.path.normpath(f"docs/reference/{name}"))
        if "--check" not in sys.argv[1:]:
            (REFERENCE / name).write_text(text, encoding="utf-8")
    return 1 if stale and "--check" in sys.argv[1:] else 0


def _has_text(path: Path, text: str) -> bool:
    """Return whether a file exists and has this text."""
    return path.is_file() and path.read_text(encoding="utf-8") == text


def make_pages() -> dict[str, str]:
    """Return the text of every generated page by its path below docs/reference."""
    return {
        COMMANDS: _commands_page(),
        SETTINGS: _settings_page(),
        EXPORTERS: _exporters_page((REFERENCE / EXPORTERS).read_text(encoding="utf-8")),
        FORMATS: _formats_page((REFERENCE / FORMATS).read_text(encoding="utf-8")),
    }


def _all_commands() -> dict[str, Any]:
    """Return every command by its name; a command of a group has both names, such as "lab chart"."""
    from gsmerge.cli.app import app

    commands: dict[str, Any] = {}
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        if command.hidden:
            continue
        inner = getattr(command, "commands", None)
        commands |= {name: command} if inner is None else {f"{name} {last}": one for last, one in inner.items()}
    return commands


def _commands_page() -> str:
    """Return the page of all commands, with their arguments and options.

    An option that an earlier command has with the same help is only named, with a link to that command.
    """
    known: dict[tuple[str, str], str] = {}  # first command that has an option with some help
    lines = [NOTICE, "", COMMANDS_HEAD]
    for name, command in _all_commands().items():
        lines += ["", f"## gsmerge {name}", "", " ".join(command.help.split()), ""]
        shared: dict[str, list[str]] = {}  # names of options by the command that describes them
        for param in (*_arguments(command), *_options(command)):
            words = "" if param.name == "set" else param.help  # the help of --set differs only in its example
            owner = known.setdefault((param.name, words), name)
            if owner == name:
                lines.append(_entry(param))
            else:
                shared.setdefault(owner, []).append(f"`{_name(param)}`")
        lines += [
            f"- as [{owner}](#gsmerge-{owner.replace(' ', '-')}): {', '.join(names)}" for owner, names in shared.items()
        ]
    return "\n".join([*lines, ""])


def _arguments(command: Any) -> list[Any]:
    """List the arguments of a command."""
    return [p for p in command.params if p.param_type_name == "argument"]


def _options(command: Any) -> list[Any]:
    """List the options of a command except help."""
    return [p for p in command.params if p.param_type_name == "option" and p.name not in ("help", "help_all")]


def _name(param: Any) -> str:
    """Return the name of an argument, or the first name of an option."""
    return str(param.opts[0] if param.param_type_name == "option" else param.metavar or param.name.upper())


def _entry(param: Any) -> str:
    """Return the line of an argument, or of an option with its names, value, default and help."""
    if param.param_type_name == "argument":
        return f"- `{_name(param)}`: {_line(param.help)}"
    names = sorted((*param.opts, *param.secondary_opts), key=lambda name: (not name.startswith("--"), name))
    value = "" if param.is_flag else f" {_line(param.metavar)}"  # a word in capitals, or a list of words
    default = _line(_default(param))
    return f"- `{', '.join(names)}{value}`{f' ({default})' if default else ''}: {_line(param.help)}"


def _default(param: Any) -> str:
    """Return an option's default in the words of its help; empty if there is none, or for a switch that is off."""
    if isinstance(param.show_default, str):
        return str(param.show_default)
    value = param.default
    if not param.show_default or param.required or value is None or value is False or callable(value):
        return ""
    return "on" if value is True else str(value)


def _line(text: str | None) -> str:
    """Return a text in one line, without the markup of rich."""
    return " ".join((text or "").split()).replace("\\[", "[")


def _cell(text: str | None) -> str:
    """Return a text for the cell of a table: in one line, with its column separators escaped."""
    return _line(text).replace("|", "\\|")


def _settings_page() -> str:
    """Return the page of all settings that are not options, by topic."""
    from gsmerge.settings.compact import CompactOptions
    from gsmerge.settings.extend import ExtendOptions
    from gsmerge.settings.files import FileOptions, PlacementOptions
    from gsmerge.settings.reading import FileHints
    from gsmerge.settings.setting import flat_settings, settings_of

    settings_of_run = settings_of(CompactOptions)
    groups = {name: list(flat_settings(one.kind).values()) for name, one in settings_of_run.items() if one.is_group}
    tables = {
        "How many Gaussians": groups["budget"] + groups["blocks"] + groups["decode"],
        "Superpixels": groups["segment"],
        "Merging across views": groups["match"],
        "Fit": groups["fit"],
        "Before and after": groups["prepare"] + groups["clean"],
        "The whole run": [setting for name, setting in settings_of_run.items() if name not in groups],
        "Files": list(flat_settings(FileOptions).values()),
        "gsmerge convert": list(flat_settings(PlacementOptions).values()),
        "gsmerge extend": list(flat_settings(ExtendOptions).values()),
    }
    commands = _all_commands()
    options = {p.name for name in ("compact", "convert") for p in _options(commands[name])}
    lines = [NOTICE, "", SETTINGS_HEAD]
    for title, settings in tables.items():
        rest = [setting for setting in settings if setting.name not in options]
        lines += ["", f"## {title}", "", *_setting_lines(rest)] if rest else []
    lines += ["", "## Hints", "", "`--hint NAME=VALUE` says how to read a file that is recognised wrongly.", ""]
    return "\n".join([*lines, *_setting_lines(flat_settings(FileHints).values()), ""])


def _exporters_page(page: str) -> str:
    """Return the page of exporters with a new list of models, by what a run does with their output."""
    from gsmerge.reading.exporters import EXPORTERS

    results: dict[str, list[str]] = {}
    for exporter in EXPORTERS.values():
        for model in exporter.models:
            output = model.output.partition(";")[0].replace("no cameras", "")
            facts = "; ".join(filter(None, (f"`{exporter.name}`", output)))
            results.setdefault(model.result, []).append(f"{model.title} ({facts})")
    return _renew(page, "models", [f"- *{result}*: {'; '.join(models)}" for result, models in results.items()])


def _formats_page(page: str) -> str:
    """Return the page of formats with a new table of formats of Gaussians, and a new list of formats of cameras."""
    from gsmerge.io.cameras.table import CAMERA_FORMATS
    from gsmerge.io.formats.table import FORMATS as ROWS

    rows = [
        (f"`{row.ending}`", "no" if row.read is None else "yes",
         f"to degree {row.max_degree}" if row.max_degree >= 0 else "no",
         " / ".join(f"{row.gaussian_bytes[i]:.0f}" for i in (0, 3) if i < len(row.gaussian_bytes)), row.about)
        for row in ROWS
    ]  # fmt: skip
    page = _renew(page, "formats", _table_lines(("name", "read", "written", "bytes", "what it is"), rows))
    attributes = {"scales": "sizes", "sh0": "`f_dc`", "shN": "harmonics", "opacities": "opacities"}
    held = [
        (f"`{row.ending}`", *(_held_values(row, name) for name in attributes))
        for row in ROWS
        if row.max_degree >= 0 and not row.inside
    ]
    page = _renew(page, "values", _table_lines(("name", *attributes.values()), held))
    cameras = (f"- {row.files}: {' '.join(row.convention)}; {row.intrinsics}" for row in CAMERA_FORMATS)
    return _renew(page, "cameras", list(cameras))


def _held_values(row: Any, name: str) -> str:
    """Describe the values of an attribute that the format of a row holds."""
    held = row.values.get(name)
    if held is None:
        return "none" if name == "shN" and row.max_degree == 0 else "no limits"
    step = f"{100 * held.step:.2g} %" if name == "scales" else f"{held.step:.2g}"
    return f"{held.low:.3g} to {held.high:.3g}" + (f", steps of {step}" if held.step else "")


def _table_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    lines = ["| " + " | ".join(map(_cell, row)) + " |" for row in (head, *rows)]
    return [lines[0], "|---" * len(head) + "|", *lines[1:]]


def _renew(page: str, name: str, lines: Sequence[str]) -> str:
    """Replace what lies between the comment that names a part of a page and the comment that ends it."""
    start, end = f"<!-- {name}: made by docs/generate_reference.py from the program -->\n", "\n<!-- end -->"
    before, _, rest = page.partition(start)
    _, found, after = rest.partition(end)
    if not found:
        raise ValueError(f"expected {name!r} between {start.strip()} and {end.strip()}")
    return before + start + "\n".join(["", *lines, ""]) + end + after


def _setting_lines(settings: Iterable[Any]) -> list[str]:
    """Return a line for each setting: its name, default, possible values and description."""
    lines = []
    for setting in settings:
        default = "" if setting.default is None or setting.is_group else f"`{_plain(setting.default)}`"
        facts = "; ".join(filter(None, (default, _line(setting.values()) if setting.words else "")))
        text = _line(setting.text)
        lines.append(f"- `{setting.name}`{f' ({facts})' if facts else ''}: {text}")
    return lines


def _plain(value: Any) -> Any:
    """Return a value as it is written in TOML or JSON."""
    if isinstance(value, bool):
        return str(value).lower()
    return list(value) if isinstance(value, tuple) else f"{value:.3g}" if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
