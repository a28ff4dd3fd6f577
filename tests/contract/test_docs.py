"""The documentation names what there is, and only that."""

from __future__ import annotations

import ast
import inspect
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer.main
from scripts import load_script

import gsmerge
from gsmerge.cli.app import app
from gsmerge.drawing.pages.view import Page
from gsmerge.io.formats.table import FORMATS
from gsmerge.results.report import report_document
from gsmerge.settings.compact import method_names
from gsmerge.settings.files import PlacementOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.types import Pixels

ROOT = Path(__file__).parents[2]
TOP: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
LAB: dict[str, Any] = TOP["lab"].commands
COMMANDS = {name: command for name, command in TOP.items() if name != "lab"} | {f"lab {n}": c for n, c in LAB.items()}


PAGES = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("*.md"))
PAGES += sorted(str(path.relative_to(ROOT)) for name in ("docs", "examples") for path in (ROOT / name).rglob("*.md"))
MADE = ("docs/reference/commands", "docs/reference/settings")
GENERATED = {page for page in PAGES if page.startswith(MADE)}
WRITTEN = [page for page in PAGES if page not in GENERATED]
# options of tools that pages name beside our own
OTHER_OPTIONS = {"--version", "--help", "--help-all", "--debug", "--only", "--no-deps", "--force-reinstall", "--check"}


def options(command: Any) -> set[str]:
    names = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
    return {name for name in names if name.startswith("--")} - {"--help", "--help-all"}


def read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks_in(page: str) -> list[list[str]]:
    """Return every ``gsmerge ...`` call in each of a page's shell blocks."""
    blocks = re.findall(r"```(?:bash|console)\n(.*?)```", read(page), re.DOTALL)
    parts = [[part.strip() for line in block.splitlines() for part in line.split("&&")] for block in blocks]
    return [[re.sub(r"^\S*/", "", call) for call in calls if re.match(r"(\S*/)?gsmerge ", call)] for calls in parts]


def calls_in(page: str) -> list[str]:
    """Return every ``gsmerge ...`` call in a page's shell blocks."""
    return [call for calls in blocks_in(page) for call in calls]


def parse(call: str) -> None:
    """Parse a call, which raises where an argument is wrong; a scene's name as the command is ``compact``."""
    words = shlex.split(call, comments=True)[1:]
    number = 2 if words[:1] == ["lab"] else 1
    name, rest = " ".join(words[:number]), words[number:]
    if name in ("", "--help", "--version", "COMMAND") or rest == ["--set", "help"]:
        return
    if name not in COMMANDS and (Path(name).suffix in (".ply", ".gsm") or name.endswith("/")):
        name, rest = "compact", words
    COMMANDS[name].make_context(name, rest)


def test_commands_are_the_documented_ones() -> None:
    assert list(TOP) == ["compact", "convert", "batch", "extend", "inspect", "view", "render", "evaluate", "lab"]
    assert sorted(LAB) == ["chart", "generate", "stress", "train"]


def test_generated_pages_are_up_to_date() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "generate_reference.py"), "--check"],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, f"run python docs/generate_reference.py to renew\n{done.stdout}{done.stderr}"


def test_formats_are_those_of_the_tables() -> None:
    """The guide names formats that there are, and leads to the reference, which has all of them."""
    page = read("docs/guide/convert.md")
    cells = next(line for line in page.splitlines() if line.startswith("| Gaussians")).split("|")[2:4]
    known = [{row.ending for row in FORMATS if row.read}, {row.ending for row in FORMATS}]
    for cell, endings in zip(cells, known, strict=True):
        assert set(re.findall(r"`([^` ]+)`", cell)) <= endings
        assert "../reference/formats.md" in page


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_page_shows_every_command(name: str) -> None:
    assert any(f"{call} ".startswith(f"gsmerge {name} ") for page in WRITTEN for call in calls_in(page))


@pytest.mark.parametrize("page", WRITTEN)
def test_pages_name_only_options_that_exist(page: str) -> None:
    known = OTHER_OPTIONS.union(*(options(command) for command in COMMANDS.values()))
    if page == "CHANGELOG.md":  # which names what was renamed, too
        return
    named = set(re.findall(r"`(--[a-z-]+)", read(page)))
    assert named - known == set()


@pytest.mark.parametrize("page", [page for page in WRITTEN if calls_in(page)])
def test_calls_on_a_page_parse(page: str) -> None:
    for call in calls_in(page):
        parse(call)


@pytest.mark.parametrize("page", [page for page in WRITTEN if "python benchmarks/" in read(page)])
def test_benchmarks_that_pages_name_are_there(page: str) -> None:
    """Their scripts, and their options."""
    text = re.sub(r"`[^`]*`", lambda code: code[0].replace("\n", " "), read(page))
    for name, words in re.findall(r"python (benchmarks/\w+\.py)([^`\n]*)", text):
        source = (ROOT / name).read_text()
        assert [option for option in re.findall(r"--[a-z-]+", words) if f'"{option}"' not in source] == [], name


@pytest.mark.parametrize("page", [page for page in WRITTEN if "```python" in read(page)])
def test_python_on_a_page_uses_public_names(page: str) -> None:
    for block in re.findall(r"```python\n(.*?)```", read(page), re.DOTALL):
        compile(block, page, "exec")
        for module, names in re.findall(r"^from (gsmerge[\w.]*) import ([\w, ]+)$", block, re.MULTILINE):
            if module.startswith("gsmerge.research.training"):
                pytest.importorskip("torch", reason="torch is not installed")
            assert all(hasattr(import_module(module), name.strip()) for name in names.split(","))
        for name in re.findall(r"\bgsmerge\.(\w+)", block):
            assert hasattr(gsmerge, name) or name in ("io", "measure"), name


# What variables of these names are in pages
VARIABLES: dict[str, type] = {
    "scene": gsmerge.Scene, "gaussians": gsmerge.Gaussians, "cameras": gsmerge.Cameras, "pixels": Pixels,
    "result": gsmerge.CompactResult, "small": gsmerge.CompactResult, "report": gsmerge.CompactReport,
    "compactor": gsmerge.Compactor, "rendering": gsmerge.Rendering, "evaluation": gsmerge.Evaluation, "page": Page,
}  # fmt: skip


@pytest.mark.parametrize("page", [page for page in WRITTEN if "\nimport gsmerge\n" in read(page)])
def test_attributes_in_python_on_a_page_exist(page: str) -> None:
    """In blocks, with their comments, and in the text of the guide to Python."""
    blocks = re.findall(r"```python\n(.*?)```", read(page), re.DOTALL)
    parts = [block for block in blocks if "import gsmerge" in block]
    parts += re.findall(r"`([^`]+)`", read(page)) if page == "docs/guide/python.md" else []
    for part in parts:
        code = re.sub(r'"[^"]*"|from [\w.]+', "", part)
        for variable, name in re.findall(rf"\b({'|'.join(VARIABLES)})\.(\w+)", code):
            kind = VARIABLES[variable]
            assert name in {*dir(kind), *getattr(kind, "__dataclass_fields__", ())}, f"{variable}.{name}"


@pytest.mark.parametrize("page", PAGES)
def test_links_on_a_page_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", read(page), flags=re.DOTALL)):
        if "://" in target or target.startswith("../../actions/"):  # pages of the repository's host
            continue
        name, _, section = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.exists(), target
        if section:
            headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            headings += re.findall(r"^::: (\S+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert section in {
                *headings,
                *(re.sub(r"[^\w -]", "", h.lower()).strip().replace(" ", "-") for h in headings),
            }, target


def test_every_public_name_is_on_the_page_of_python() -> None:
    """There the site has the docstrings."""
    names = re.findall(r"^::: gsmerge\.(\w+)$", read("docs/reference/api.md"), re.MULTILINE)
    assert sorted(names) == sorted({*gsmerge.__all__, "integrations"} - {"__version__"})


def test_every_page_and_what_it_links_to_is_on_the_site() -> None:
    site = load_script(ROOT / "docs" / "build_site.py")
    settings = site.SETTINGS.read_text(encoding="utf-8")
    assert site.find_missing(settings) == []
    assert set(PAGES) <= set(site.pages_of(settings))


def test_the_site_refuses_what_would_be_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Pages without a place, and links to folders, to files that are not there and to pages without a place."""
    site = load_script(ROOT / "docs" / "build_site.py")
    (tmp_path / "docs").mkdir()
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / "README.md").write_text("# Examples\n")
    (tmp_path / "docs" / "lost.md").write_text("# Lost\n")
    links = "[a](../README.md#a) [b](../examples) [c](none.md) [d](../examples/README.md) [e](https://example.org/x)"
    (tmp_path / "docs" / "page.md").write_text(f"# Page\n\n{links}\n\n```\n[f](code.md)\n```\n")
    (tmp_path / "README.md").write_text("[![badge](../../actions/badge.svg)](../../actions)\n")
    monkeypatch.setattr(site, "ROOT", tmp_path)
    monkeypatch.setattr(site, "SETTINGS", tmp_path / "docs" / "zensical.toml")
    lines = site.find_missing('nav = ["README.md", "docs/page.md", "docs/gone.md"]')
    places = [(line.partition(": ")[0], line.split()[-1]) for line in lines]
    assert [place for place, _ in places] == ["docs/lost.md", *["docs/page.md"] * 3, "docs/zensical.toml"]
    assert [word for _, word in places[1:3]] == ["docs/none.md", "examples"]


@pytest.mark.parametrize("page", WRITTEN)
def test_lists_in_lists_are_indented_by_four(page: str) -> None:
    """The site reads fewer as a list of its own, which the repository's host does not show."""
    assert re.findall(r"^ {1,3}[-*] .*$", read(page), re.MULTILINE) == []


def test_index_of_the_documentation_links_every_page() -> None:
    index = read("docs/README.md")
    pages = [page.removeprefix("docs/") for page in PAGES if page.startswith("docs/")]
    assert [page for page in pages if page != "README.md" and f"]({page})" not in index] == []


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_option_has_help(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    assert [p.name for p in command.params if not p.help] == []


def test_every_method_is_described() -> None:
    text = read("docs/internals/adding.md")
    assert [method for method in method_names() if f"| `{method}` |" not in text] == []


def test_every_option_is_a_field_of_the_api() -> None:
    fields = set(gsmerge.CompactOptions().to_dict())
    own = {
        "cameras",
        "images",
        "masks",
        "protect",
        "hint",
        "set",
        "output",
        "overwrite",
        "report",
        "save-cameras",
        "strict",
        "embed-cameras",
        "engine",
        "address",
        "dry-run",
        "open",
        "no-open",
        "progress",
        "json",
        "verbose",
        "quiet",
    }
    own |= set(flat_settings(PlacementOptions))  # of what is written, in whose frame nothing else is done
    names = {option.removeprefix("--") for option in options(COMMANDS["compact"])} - own
    assert {name.replace("-", "_") for name in names} - fields == set()


def test_every_key_of_the_report_is_described() -> None:
    """Keys that the program names of the JSON report, see :func:`gsmerge.results.report.report_document`."""
    source = inspect.getsource(report_document)
    keys = set(re.findall(r'^ {8}"(\w+)":', source, re.MULTILINE)) | {f.name for f in fields(gsmerge.CompactReport)}
    text = read("docs/reference/report.md")
    assert {key for key in keys if f"`{key}`" not in text} == set()


def test_constraints_pin_every_dependency(root: Path) -> None:
    project = (root / "pyproject.toml").read_text().split("[project.scripts]")[0]
    expected = set(re.findall(r'"([a-z][a-z0-9-]+)>=', project.split("dependencies = [")[1]))
    pinned = dict(re.findall(r"^([a-z0-9-]+)==(\S+)$", (root / "constraints.txt").read_text(), re.MULTILINE))
    assert len(expected) > 10
    assert expected - set(pinned) == set()


def stability_rows(root: Path) -> list[tuple[str, str]]:
    """Return numbers and tests of every row of cases."""
    text = (root / "docs" / "internals" / "stability.md").read_text()
    return re.findall(r"^\| ([\d, ]+) \| .+ \| .+ \| (.+) \|$", text, re.MULTILINE)


def test_every_stability_case_is_listed(root: Path) -> None:
    numbers = [int(n) for case, _ in stability_rows(root) for n in case.split(",")]
    assert numbers == list(range(1, 71))


def test_stability_cases_name_tests_that_are_there(root: Path) -> None:
    for case, tests in stability_rows(root):
        folder = ""
        for name, words in re.findall(r"`([\w/*]+)`(?:: ([\w, ]+))?", tests):
            folder = str(Path(name).parent) if "/" in name else folder
            files = list((root / "tests").glob(f"{folder}/{Path(name).name}.py"))
            assert files, f"case {case}: {name}"
            text = "".join(file.read_text() for file in files)
            for word in filter(None, re.split(r"[, ]+", words)):
                assert re.search(rf"def test_\w*{word}", text), f"case {case}: {name} has no test of {word}"


def test_generator_names_every_range(root: Path) -> None:
    from gsmerge.research.generate import NoiseOptions

    text = (root / "docs" / "internals" / "networks.md").read_text()
    assert [f.name for f in fields(NoiseOptions) if f"`{f.name}`" not in text] == []


def test_security_names_the_programs_that_commands_start() -> None:
    sources = "".join(path.read_text("utf-8") for path in (ROOT / "gsmerge").rglob("*.py"))
    said = (ROOT / "SECURITY.md").read_text("utf-8")
    programs = re.findall(r'shutil\.which\("(\w+)"\)', sources)
    assert programs
    assert [program for program in programs if f"`{program}`" not in said] == []


def functions_of(node: ast.AST) -> Iterator[ast.FunctionDef]:
    """Return the functions in a node's statements, whose expressions hold none."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
            if isinstance(child, ast.FunctionDef):
                yield child
            yield from functions_of(child)


def test_package_has_no_long_file_or_function() -> None:
    """As CONTRIBUTING.md says; docstrings do not count."""
    long = list[str]()
    for path in (ROOT / "gsmerge").rglob("*.py"):
        text = path.read_text("utf-8")
        long += [path.name] if len(text.splitlines()) > 600 else []
        for node in functions_of(ast.parse(text)):
            docstring = node.body[0] if ast.get_docstring(node, clean=False) else None
            of_docstring = 0 if docstring is None else docstring.end_lineno - docstring.lineno + 1  # type: ignore
            long += [node.name] if node.end_lineno - node.lineno + 1 - of_docstring > 60 else []  # type: ignore
    assert long == []
