"""Writes the pages of docs/reference that are made from the program itself.

python docs/generate_reference.py          # write the pages that differ
python docs/generate_reference.py --check  # name them, exit code 1 if there are any; write nothing
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, get_args

import typer.main
from api_page import api_page

from gsmerge.cli.parameters import METAVARS

REFERENCE = Path(__file__).parent / "reference"
COMMANDS, SETTINGS, API = "commands.md", "settings.md", "api.md"
EXPORTERS, FORMATS = "exporters.md", "formats.md"  # whose prose is written by hand, and whose tables are made
NOTICE = "<!-- Made by docs/generate_reference.py from the program: change the help there and run it again. -->"
BARE = ("a whole number", "a number", "text", "true or false")  # values that the default or the text shows as well
KINDS = {int: "NUMBER", float: "NUMBER", str: "TEXT", Path: "PATH"}
COMMANDS_HEAD = """# Commands

`gsmerge COMMAND --help` prints the same. What is in brackets is the default. [Exit codes](exit-codes.md)."""
SETTINGS_HEAD = """# Settings

`compact`, `batch`, `extend` and `lab stress` take them as `--set NAME=VALUE`, such as `--set poses=fixed`; in Python
they are arguments of `gsmerge.compact`. `--set help` lists those of a command. In brackets: the default, and the
possible values; without a default the program chooses. [Options](commands.md#gsmerge-compact) of `compact` are
settings, too: `--k 2` is `--set k=2`."""


def main() -> int:
    """Write the pages, or name those that are stale."""
    stale = {name: text for name, text in make_pages().items() if not _same(REFERENCE / name, text)}
    for name, text in stale.items():
        print(f"docs/reference/{name}")
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
    """Usage, arguments and options of every command; what an earlier command has in the same words is only named."""
    known: dict[tuple[str, str], str] = {}
    lines = [NOTICE, "", COMMANDS_HEAD]
    for name, command in _all_commands().items():
        usage = " ".join(["gsmerge", name, *command.collect_usage_pieces(None)])
        lines += ["", f"## gsmerge {name}", "", " ".join(command.help.split()), "", "```console", usage, "```", ""]
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        lines += [f"- `{p.metavar or p.name.upper()}`: {_line(p.help)}" for p in arguments]
        same: dict[str, list[str]] = {}
        for option in _options(command):
            owner = known.setdefault((option.name, option.help), name)
            if owner == name:
                lines.append(_option(option))
            else:
                same.setdefault(owner, []).append(f"`{option.opts[0]}`")
        lines += [
            f"- as [{owner}](#gsmerge-{owner.replace(' ', '-')}): {', '.join(names)}" for owner, names in same.items()
        ]
    return "\n".join([*lines, ""])


def _options(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "option" and p.name not in ("help", "help_all")]


def _option(param: Any) -> str:
    """A line for an option: its names, its value, its default, and its help."""
    from gsmerge.settings.compact import CompactOptions
    from gsmerge.settings.setting import flat_settings

    named = sorted((*param.opts, *param.secondary_opts), key=lambda name: (not name.startswith("--"), name))
    value = "" if param.is_flag else f" {_value(param)}"
    default = _line(_default(param))
    setting = flat_settings(CompactOptions).get(param.name)
    text = _line(setting.text if setting and setting.help == param.help else param.help)
    return f"- `{', '.join(named)}{value}`{f' ({default})' if default else ''}: {text}"


def _value(param: Any) -> str:
    """What an option takes, as a word in capitals or a list of words."""
    if param.metavar and param.metavar not in METAVARS.values():
        return _line(param.metavar)
    kind = param.type_descriptor.annotation
    kind = next((k for k in get_args(kind) if k is not type(None)), kind)  # of a list, or of an optional one
    return KINDS.get(kind, "TEXT")


def _default(param: Any) -> str:
    """The default as help words it; empty where there is none, or where it says nothing, as of a switch."""
    if isinstance(param.show_default, str):
        return str(param.show_default)
    value = getattr(param.default, "value", param.default)
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
    from gsmerge.cli.paths import FileOptions
    from gsmerge.settings.compact import CompactOptions
    from gsmerge.settings.extend import ExtendOptions
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
    """Renew the lists of a page: what lies between the comments that name them and those that end them."""
    from gsmerge.scene.exporters import EXPORTERS
    from gsmerge.scene.no_gaussians import POINTS_ONLY

    exporters = EXPORTERS.values()
    page = _renew(page, "names", [f"- `{one.name}`: {'; '.join(_habits(one))}" for one in exporters])
    results: dict[str, list[str]] = {}
    for model in (model for one in exporters for model in one.models):
        results.setdefault(model.result, []).append(f"{model.title} ({model.leaves})")
    page = _renew(page, "models", [f"- *{result}*: {'; '.join(models)}" for result, models in results.items()])
    files = ((row, ", ".join(f"`{file}`" for file in row.files)) for row in POINTS_ONLY)
    return _renew(page, "points", [f"- {row.title} ({names}): {row.remedy}" for row, names in files])


def _habits(exporter: Any) -> list[str]:
    """What an exporter does, but for what most do: logits, rotations wxyz, degree 0, normals."""
    order = "rows without pixels" if exporter.order == "none" else exporter.order
    kinds = "" if exporter.order == "none" else ", ".join(exporter.kinds)
    degrees = "" if exporter.degrees == (0,) else f"degree {', '.join(map(str, exporter.degrees))}"
    quats = "" if exporter.quats == "wxyz" else f"rotations {exporter.quats}"
    opacity = "" if exporter.opacity == "logit" else f"{exporter.opacity} opacities"
    normals = "normals as bytes" if exporter.byte_columns else "" if exporter.normals else "no normals"
    elements = ", ".join(f"`{name}`" for name in exporter.elements)
    comment = exporter.comment and f"comment {exporter.comment}"
    return [fact for fact in (order, kinds, opacity, quats, degrees, normals, elements, comment) if fact]


def _formats_page(page: str) -> str:
    """Renew the tables of formats, of Gaussians and of cameras."""
    from gsmerge.io.cameras.read import CAMERA_FORMATS
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
        values = _line(one.values(null=False))
        facts = "; ".join(filter(None, (default, "" if values in BARE else values)))
        lines.append(f"- `{one.name}`{f' ({facts})' if facts else ''}: {_line(one.text)}")
    return lines


def _plain(value: Any) -> Any:
    """A value as TOML or JSON has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return list(value) if isinstance(value, tuple) else f"{value:.3g}" if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
