"""A version that was released keeps what is public: whatever changes it calls itself otherwise."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import pytest

import gsmerge

MOST_LINES = 40  # of a section of the changelog


@pytest.fixture(scope="module")
def tool(root: Path) -> dict[str, Any]:
    return runpy.run_path(str(root / "tools/public_names.py"))


def test_a_released_version_keeps_what_is_public(tool: dict[str, Any]) -> None:
    released = json.loads(tool["RECORD"].read_text(encoding="utf-8"))
    version = released.pop("version")
    if gsmerge.__version__ == version:
        now = json.loads(json.dumps(tool["public_names"]()))
        gone, new = (sorted(set(_flat(a)) - set(_flat(b))) for a, b in ((released, now), (now, released)))
        remedy = f"{version} is released: bring back what is gone, or set the next version with .dev0 (CONTRIBUTING.md)"
        assert (gone, new) == ([], []), f"gone: {', '.join(gone)}; new: {', '.join(new)}; {remedy}"
    else:
        assert _numbers(gsmerge.__version__) > _numbers(version), "run python tools/public_names.py for a release"
        assert gsmerge.__version__.endswith(".dev0"), "a release has its record: run python tools/public_names.py"


def _flat(value: Any, place: str = "") -> list[str]:
    """List the leaves of a record with the names above them."""
    if isinstance(value, dict):
        return [leaf for name, inner in value.items() for leaf in _flat(inner, f"{place}.{name}".strip("."))]
    if isinstance(value, list):
        return [place, *(f"{place}.{each}" for each in value)]
    return [f"{place} {value}"]


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version.partition(".dev")[0])]


def test_the_record_is_of_the_newest_section_with_a_date(root: Path, tool: dict[str, Any]) -> None:
    changelog = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## (\d\S+) \((\d{4}-\d\d-\d\d)\)$", changelog, re.MULTILINE)
    assert json.loads(tool["RECORD"].read_text(encoding="utf-8"))["version"] == newest[1]
    section = changelog[newest.end() :].partition("\n## ")[0]
    assert len([line for line in section.splitlines() if line.strip()]) <= MOST_LINES
    citation = (root / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {newest[1]}\ndate-released: {newest[2]}\n" in citation, "CITATION.cff has another release"
