"""The documentation names what there is, and only that."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer.main

import gsmerge
from gsmerge.cli.app import app
from gsmerge.io import ReadHints
from gsmerge.options import METHODS

COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def options(command: Any) -> set[str]:
    """Long names of a command's options."""
    names = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
    return {name for name in names if name.startswith("--")} - {"--help", "--help-all"}


def readme_commands(root: Path) -> list[str]:
    """Every ``gsmerge ...`` call in the README's shell blocks."""
    blocks = re.findall(r"```bash\n(.*?)```", (root / "README.md").read_text(), re.DOTALL)
    calls = (part.strip() for block in blocks for line in block.splitlines() for part in line.split("&&"))
    return [re.sub(r"^\S*/", "", call) for call in calls if re.match(r"(\S*/)?gsmerge ", call)]


def test_commands_are_the_documented_ones() -> None:
    assert set(COMMANDS) == {
        "compact",
        "batch",
        "encode",
        "decode",
        "evaluate",
        "extend",
        "inspect",
        "segment",
        "render",
        "preview",
        "report",
        "stress",
        "chart",
        "generate",
        "train",
    }


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_readme_shows_every_command(name: str, root: Path) -> None:
    assert any(call.split()[1] == name for call in readme_commands(root))


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_readme_names_every_option(name: str, root: Path) -> None:
    text = (root / "README.md").read_text()
    assert {option for option in options(COMMANDS[name]) if f"`{option}`" not in text} == set()


def test_readme_names_no_option_that_is_not_there(root: Path) -> None:
    known = set().union(*(options(command) for command in COMMANDS.values()))
    known |= {"--version", "--help", "--install-completion"}
    named = set(re.findall(r"`(--[a-z-]+)`", (root / "README.md").read_text()))
    assert named - known == set()


def test_readme_calls_parse(root: Path) -> None:
    calls = readme_commands(root)
    assert len(calls) >= 7
    for call in calls:
        _, name, *arguments = shlex.split(call, comments=True)
        COMMANDS[name].make_context(name, arguments)  # raises where an argument is wrong


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_option_has_help(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    assert [p.name for p in command.params if not p.help] == []


def cli_defaults() -> Iterator[tuple[str, str]]:
    """Name and told default of those options of ``compact`` that leave the default to the library."""
    for param in COMMANDS["compact"].params:
        if isinstance(getattr(param, "show_default", None), str) and param.name not in (
            "output",
            "threads",
            "scene_scale",
            "max_side",
        ):
            yield param.name, param.show_default


def test_told_defaults_are_the_library_s() -> None:
    library = gsmerge.CompactOptions().to_dict()
    told = dict(cli_defaults())
    known = {"k", "superpixels", "segmentation", "method", "effort", "robust", "match", "fit", "fit_steps", "seed"}
    known |= {"levels", "device", "checkpoint", "geometry"}
    assert set(told) == known
    assert library["robust"] is None
    assert library["fit_steps"] is None
    worded = {
        "robust": "unless --fit full or a draft",
        "fit_steps": "by effort",
        "match": "overlap, none for a draft",
    }
    real = {name: worded.get(name, str(library[name])) for name in told}
    assert told == real


def test_told_sizes_are_the_readers_own(root: Path) -> None:
    (param,) = (p for p in COMMANDS["compact"].params if p.name == "max_side")
    assert param.show_default == str(ReadHints().max_side)
    assert f"| `--max-side` | {ReadHints().max_side} |" in (root / "README.md").read_text()


def test_readme_s_defaults_are_the_library_s(root: Path) -> None:
    rows = re.findall(r"^\| `--([a-z-]+)`[^|]*\| ([^|]*) \|", (root / "README.md").read_text(), re.MULTILINE)
    told = dict(rows)
    for name, default in cli_defaults():
        assert told[name.replace("_", "-")].replace("`", "") == default


def test_readme_lists_every_method(root: Path) -> None:
    text = (root / "README.md").read_text()
    assert [method for method in METHODS if f"| `{method}` |" not in text] == []


def test_every_option_is_a_field_of_the_api() -> None:
    """Merging and segmentation options carry the API's names."""
    fields = set(gsmerge.CompactOptions().to_dict())
    own = {"output", "overwrite", "report", "json", "quiet", "dry-run", "debug", "cameras", "images", "opacity"}
    own |= {"exporter", "quats", "order", "scene-scale", "max-side"}
    names = {option.removeprefix("--") for option in options(COMMANDS["compact"])} - own - {"no-robust"}
    assert {name.replace("-", "_") for name in names} - fields == set()


def test_changelog_starts_with_unreleased(root: Path) -> None:
    sections = re.findall(r"^## (.+)$", (root / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert sections[0] == "Unreleased"


def test_version_is_the_same_everywhere(root: Path) -> None:
    assert f'\nversion = "{gsmerge.__version__}"\n' in (root / "pyproject.toml").read_text()


def test_constraints_pin_every_dependency(root: Path) -> None:
    project = (root / "pyproject.toml").read_text().split("[project.scripts]")[0]
    wanted = set(re.findall(r'"([a-z][a-z0-9-]+)>=', project.split("dependencies = [")[1]))
    pinned = dict(re.findall(r"^([a-z0-9-]+)==(\S+)$", (root / "constraints.txt").read_text(), re.MULTILINE))
    assert len(wanted) > 10
    assert wanted - set(pinned) == set()


def test_architecture_names_every_module(root: Path) -> None:
    text = (root / "docs" / "architecture.md").read_text()
    modules = {path.stem for path in (root / "gsmerge").iterdir() if not path.name.startswith("_")} - {"py"}
    assert {name for name in modules if f"`{name}`" not in text and f"`{name}/`" not in text} == set()


def stability_rows(root: Path) -> list[tuple[str, str]]:
    """Number and test column of every case."""
    rows = [line.split("|") for line in (root / "docs" / "stability.md").read_text().splitlines()]
    return [(row[1].strip(), row[4]) for row in rows if len(row) > 5 and row[1].strip()[:1].isdigit()]


def test_every_stability_case_is_listed(root: Path) -> None:
    numbers = [int(n) for case, _ in stability_rows(root) for n in case.split(",")]
    assert numbers == list(range(1, 56))


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


def test_generator_names_every_range_style_and_path(root: Path) -> None:
    from gsmerge.research.generate import NoiseOptions
    from gsmerge.research.generate.paths import PATHS
    from gsmerge.research.generate.styles import STYLES

    text = (root / "docs" / "generator.md").read_text()
    names = [f.name for f in fields(NoiseOptions)] + [*STYLES, *PATHS]
    assert [name for name in names if f"`{name}`" not in text] == []
