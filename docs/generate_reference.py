"""Writes the pages of docs/reference that are made from the program itself.

python docs/generate_reference.py          # write the pages that differ, remove those of commands that are gone
python docs/generate_reference.py --check  # name them, exit code 1 if there are any; write nothing
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import typer.main
from api_page import api_page

REFERENCE = Path(__file__).parent / "reference"
COMMANDS, SETTINGS, TRAINING, API = "commands", "settings.md", "training-settings.md", "api.md"
EXPORTERS, FORMATS = "exporters.md", "formats.md"  # whose prose is written by hand, and whose tables are made
NOTICE = "<!-- Made by docs/generate_reference.py from the program: change the help there and run it again. -->"
COMMON = ("json", "quiet")  # options of all commands
HEAD = ["| option | default | what it does |", "|---|---|---|"]


def main() -> int:
    """Write the pages, or name those that are stale."""
    pages, stale = make_pages(), stale_pages()
    for name in stale:
        print(f"docs/reference/{name}")
        path = REFERENCE / name
        if "--check" in sys.argv[1:]:
            continue
        if name in pages:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(pages[name], encoding="utf-8")
        else:
            path.unlink()
    return 1 if stale and "--check" in sys.argv[1:] else 0


def stale_pages() -> list[str]:
    """Pages that are missing, differ from what the program says now, or describe a command that is gone."""
    pages = make_pages()
    present = {path.relative_to(REFERENCE).as_posix() for path in (REFERENCE / COMMANDS).glob("*.md")}
    differ = {name for name, text in pages.items() if not _same(REFERENCE / name, text)}
    return sorted(differ | (present - set(pages)))


def _same(path: Path, text: str) -> bool:
    return path.is_file() and path.read_text(encoding="utf-8") == text


def make_pages() -> dict[str, str]:
    """Every generated page by its path below docs/reference."""
    from gsmerge.cli.app import app

    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    pages = {f"{COMMANDS}/{name}.md": command_page(name, command) for name, command in commands.items()}
    pages[f"{COMMANDS}/README.md"] = _index(commands)
    pages[SETTINGS], pages[TRAINING] = _settings_page(), _training_page()
    pages[API] = f"{NOTICE}\n\n{api_page()}"
    pages[EXPORTERS] = _exporters_page((REFERENCE / EXPORTERS).read_text(encoding="utf-8"))
    pages[FORMATS] = _formats_page((REFERENCE / FORMATS).read_text(encoding="utf-8"))
    return pages


def _index(commands: dict[str, Any]) -> str:
    rows = [f"| [{name}]({name}.md) | {_cell(command.help)} |" for name, command in commands.items()]
    common = [_option_row(param) for param in commands["compact"].params if param.name in COMMON]
    lines = [
        NOTICE,
        "",
        "# Commands",
        "",
        "| command | what it does |",
        "|---|---|",
        *rows,
        "",
        "All of them have:",
        "",
    ]
    return "\n".join([*lines, *HEAD, *common, ""])


def command_page(name: str, command: Any) -> str:
    """The page of a command, or of a group of commands: usage, arguments, and a table of options."""
    lines = [NOTICE, "", f"# gsmerge {name}", ""]
    if hasattr(command, "commands"):
        lines += [command.help, ""]
        for part, one in command.commands.items():
            lines += [f"## {part}", "", *_command_lines(f"{name} {part}", one)]
        return "\n".join(lines)
    return "\n".join([*lines, *_command_lines(name, command)])


def _command_lines(name: str, command: Any) -> list[str]:
    usage = " ".join(["gsmerge", name, *command.collect_usage_pieces(None)])
    arguments = [f"| `{_cell(_metavar(p))}` | | {_cell(p.help)} |" for p in command.params if p.opts[0][0] != "-"]
    options = [_option_row(p) for p in command.params if p.opts[0][0] == "-" and p.name not in (*COMMON, "help")]
    return [" ".join(command.help.split()), "", "```console", usage, "```", "", *HEAD, *arguments, *options, ""]


def _metavar(param: Any) -> str:
    return param.metavar or param.name.upper()


def _option_row(param: Any) -> str:
    first, *others = sorted((*param.opts, *param.secondary_opts), key=_long_first)
    value = "" if param.is_flag else f" {_cell(param.metavar)}"
    names = ", ".join(f"`{name}`" for name in (first + value, *others))
    return f"| {names} | {_cell(_default(param))} | {_cell(param.help)} |"


def _long_first(name: str) -> tuple[bool, bool]:
    return not name.startswith("--"), name.startswith("--no-")


def _default(param: Any) -> str:
    """The default as help words it; empty where there is none, or where it says nothing, as of a switch."""
    if isinstance(param.show_default, str):
        return str(param.show_default)
    value = getattr(param.default, "value", param.default)
    if not param.show_default or param.required or value is None or value is False or callable(value):
        return ""
    return "on" if value is True else str(value)


def _cell(text: str | None) -> str:
    """Text for a table: one line, no markup of rich, no column separators."""
    return " ".join((text or "").split()).replace("\\[", "[").replace("|", "\\|")


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
        "Files": flat_settings(FileOptions).values(),
        "The frame of what is written": flat_settings(PlacementOptions).values(),
        "`gsmerge extend`": flat_settings(ExtendOptions).values(),
    }
    lines = [NOTICE, "", "# Settings", ""]
    lines += ["`compact`, `batch`, `extend` and `lab` take them as `--set NAME=VALUE`, such as"]
    lines += ["`--set poses=fixed --set min_opacity=0.01`; `compact` of a state takes those of the fit and of files,"]
    lines += [
        "`convert` those of files and frames; `gsmerge COMMAND --set help` lists them. In Python they are arguments of"
    ]
    lines += ["`gsmerge.compact`."]
    lines += ["A value is JSON, or text as it is; an empty default is `null`: the program chooses. Settings with"]
    lines += ["an option of their own are listed too: `--k 2` is `--set k=2`."]
    for title, settings in tables.items():
        lines += ["", f"## {title}", "", *_table(settings)]
    lines += ["", "## Hints", "", "`--hint NAME=VALUE` says how to read a file that is recognised wrongly.", ""]
    lines += _table(flat_settings(FileHints).values(), "hint")
    return "\n".join([*lines, ""])


def _exporters_page(page: str) -> str:
    """Renew the tables of a page: what lies between the comments that name them and those that end them."""
    from gsmerge.scene.exporters import EXPORTERS
    from gsmerge.scene.no_gaussians import POINTS_ONLY

    exporters = EXPORTERS.values()
    rows = [
        (f"`{e.name}`", ", ".join(model.title for model in e.models), e.order, ", ".join(e.kinds * (e.order != "none")),
         e.opacity, e.quats, ", ".join(map(str, e.degrees)), _columns(e))
        for e in exporters
    ]  # fmt: skip
    head = ("name", "models", "order", "pixels", "opacity", "rotations", "degrees", "columns besides")
    page = _renew(page, "names", head, rows)
    models = ((m.title, m.source, m.leaves, m.result) for e in exporters for m in e.models)
    points = ((row.title, ", ".join(f"`{file}`" for file in row.files), row.remedy) for row in POINTS_ONLY)
    page = _renew(page, "points", ("program", "what it leaves", "what to do"), points)
    return _renew(
        page, "models", ("model", "saving code that was read", "what it leaves", "what becomes of it"), models
    )


def _formats_page(page: str) -> str:
    """Renew the tables of formats, of Gaussians and of cameras."""
    from gsmerge.io.cameras.read import CAMERA_FORMATS
    from gsmerge.io.formats.table import FORMATS as ROWS

    rows = [
        (f"`{row.ending}`", "no" if row.read is None else "yes",
         str(row.max_degree) if row.max_degree >= 0 else "not written",
         *(f"{row.each[i]:.0f}" if i < len(row.each) else "" for i in (0, 3)), row.about)
        for row in ROWS
    ]  # fmt: skip
    head = ("ending or name", "read", "written harmonics, up to degree", "bytes each", "of degree 3", "what it is")
    page = _renew(page, "formats", head, rows)
    cameras = ((row.files, " ".join(row.convention), row.intrinsics) for row in CAMERA_FORMATS)
    return _renew(page, "cameras", ("file", "poses, axes", "intrinsics"), cameras)


def _columns(exporter: Any) -> str:
    """What a file has besides the 14 columns of all."""
    normals = "normals as bytes" if exporter.byte_columns else "normals" if exporter.normals else ""
    marks = (normals, *(f"`{name}`" for name in exporter.elements), exporter.comment and f"comment {exporter.comment}")
    return ", ".join(mark for mark in marks if mark)


def _renew(page: str, name: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(map(_cell, row)) + " |" for row in (head, *rows)]
    lines.insert(1, "|---" * len(head) + "|")
    start, end = f"<!-- {name}: made by docs/generate_reference.py from the program -->\n", "\n<!-- end -->"
    before, _, rest = page.partition(start)
    _, found, after = rest.partition(end)
    if not found:
        raise ValueError(f"expected a table {name!r} between {start.strip()} and {end.strip()}")
    return before + start + "\n".join(["", *lines, ""]) + end + after


def _training_page() -> str:
    from gsmerge.networks.options import NetworkOptions
    from gsmerge.research.training import TrainOptions
    from gsmerge.settings.setting import settings_of

    lines = [NOTICE, "", "# Settings of a training run", ""]
    lines += [
        "`gsmerge lab train` takes them as `--set NAME=VALUE`, or in a TOML or JSON file: `--set config=FILE`.",
        "",
    ]
    lines += [*_table(settings_of(TrainOptions).values()), ""]
    return "\n".join([*lines, "## The table `network`", "", *_table(settings_of(NetworkOptions).values()), ""])


def _table(settings: Iterable[Any], head: str = "setting") -> list[str]:
    """A table of settings: name, default, values, and what is said of each."""
    rows = []
    for one in settings:
        shown = "" if one.default is None or one.is_group else f"`{_plain(one.default)}`"
        rows.append(f"| `{one.name}` | {shown} | {_cell(one.values())} | {_cell(one.text)} |")
    return [f"| {head} | default | values | what it is |", "|---|---|---|---|", *rows]


def _plain(value: Any) -> Any:
    """A value as TOML or JSON has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return list(value) if isinstance(value, tuple) else f"{value:.3g}" if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
