"""The pages on the inside of the package name its packages, files and definitions, and only those that there are."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "gsmerge"
INTERNALS = sorted((ROOT / "docs" / "internals").glob("*.md"))
PAGES = [*INTERNALS, ROOT / "CONTRIBUTING.md", ROOT / "docs" / "reference" / "conventions.md"]
ARCHITECTURE = ROOT / "docs" / "internals" / "architecture.md"
# Made by a run, in folders that are not there before
MADE = {"tests/damage/findings"}
# Of other repositories
FOREIGN = {"tests/data/set1_lund_door", "colmap_ground_truth"}
SOURCES = (".py", ".c", ".h", ".toml", ".js", ".html", ".yml", ".sh")


def section(title: str, page: Path = ARCHITECTURE) -> str:
    """Return the text of a section of a page, without its title."""
    return page.read_text("utf-8").partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def names_in_table(text: str) -> list[str]:
    """Return the packages of the table, in its order."""
    return re.findall(r"^\| `([\w/]+)` \|", text, re.MULTILINE)


def layers(name: str) -> list[str]:
    """Return the folders and modules of an import contract, from the top; those of one layer in its order."""
    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    (contract,) = [one for one in contracts if one["name"] == name]
    return [name for layer in contract["layers"] for name in layer.split(" | ")]


def test_packages_of_the_page_follow_the_import_contract() -> None:
    assert [name.rstrip("/") for name in names_in_table(section("Packages"))] == layers("Imports flow down")
    assert [name.rstrip("/") for name in names_in_table(section("Method"))] == layers("Imports of the method flow down")


def test_packages_are_the_folders_and_modules_of_the_package() -> None:
    inside = {f"{path.parent.name}/" for path in PACKAGE.glob("*/__init__.py")}
    inside |= {path.stem for path in PACKAGE.glob("*.py") if not path.stem.startswith("__")}
    listed = names_in_table(section("Packages"))
    assert set(listed) == inside
    assert len(listed) == len(inside)


def stages() -> list[list[str]]:
    """Return the cells of the table of stages."""
    lines = [line for line in section("Stages").splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_table_of_stages_follows_the_line_from_files_to_ply() -> None:
    """Rows without a name go on with the stage above them."""
    line = re.search(r"^    files -> (.+)$", ARCHITECTURE.read_text("utf-8"), re.MULTILINE)
    assert line is not None
    assert [row[0] for row in stages() if row[0]] == line[1].split(" -> ")


def test_functions_in_the_table_of_stages_are_in_the_files_beside_them() -> None:
    for _, functions, files, _ in stages():
        modules = [import_module("gsmerge." + name.replace("/", ".")) for name in re.findall(r"`([\w/]+)`", files)]
        names = re.findall(r"`(\w+)`", functions)
        assert names
        for name in names:
            owners = [value for module in modules for value in (module, *vars(module).values())]
            assert any(hasattr(owner, name) for owner in owners), name


def test_table_of_cameras_has_each_file_of_that_folder() -> None:
    cells = "".join(line.split("|")[1] for line in section("Cameras").splitlines() if line.startswith("| `"))
    files = [path for path in (PACKAGE / "reading/alignment").iterdir() if not path.name.startswith("_")]
    names = {path.stem if path.is_file() else f"{path.name}/" for path in files}
    assert set(re.findall(r"`([\w/]+)`", cells)) == names


def code_spans(page: Path) -> Iterator[str]:
    """Return what stands between backticks in the text of a page."""
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    yield from (span.replace("\n", " ") for span in re.findall(r"`([^`]+)`", text))


@cache
def top() -> tuple[set[str], set[str]]:
    """Return the names of folders of the package, and of the repository."""
    return tuple({path.name for path in folder.iterdir() if path.is_dir()} for folder in (PACKAGE, ROOT))  # type: ignore


def is_there(name: str) -> bool:
    """Return whether a path of a page leads to a file or folder of the package, or of the repository."""
    return any(
        (base / f"{name}{ending}").exists() for base in (PACKAGE, ROOT, ROOT / "tests") for ending in ("", ".py", ".c")
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_paths_on_a_page_lead_to_files(page: Path) -> None:
    folders = set.union(*top())
    paths = [span for span in code_spans(page) if re.fullmatch(r"[\w.-]+(/[\w.-]+)+/?", span)]
    own = [path for path in paths if path.split("/")[0] in folders and path.rstrip("/") not in MADE | FOREIGN]
    assert [path for path in own if not is_there(path.rstrip("/"))] == []


@cache
def words_of_sources() -> set[str]:
    """Return all identifiers of the repository's code, tests included, and the names of its files."""
    files = [path for name in ("gsmerge", "benchmarks", "docs", "tests", "tools", "examples", ".github")
             for path in (ROOT / name).rglob("*") if path.suffix in SOURCES and path != Path(__file__)]  # fmt: skip
    texts = [path.read_text("utf-8") for path in (*files, ROOT / "pyproject.toml")]
    return {path.stem for path in files} | {word for text in texts for word in re.findall(r"\w+", text)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_on_a_page_are_names_of_the_code(page: Path) -> None:
    """Names with an underscore or a capital inside, which are those of definitions, settings and keys."""
    spans = [re.sub(r"^--(hint|set) ", "", span) for span in code_spans(page)]
    names = {name for span in spans for name in re.findall(r"\b(?:[A-Za-z]+_\w+|[A-Z][a-z]+[A-Z]\w+)\b", span)}
    assert sorted(names - words_of_sources() - FOREIGN) == []
