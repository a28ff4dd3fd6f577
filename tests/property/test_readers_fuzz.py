"""Every reader on changed files: an answer or an error of the package, nothing else; python tasks.py fuzz tries more.

``GSMERGE_FUZZ_EXAMPLES`` sets how many files each reader tries.
"""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

import pytest
from fuzz.mutate import mutate
from fuzz.targets import TARGETS, seeds_of

EXAMPLES = int(os.environ.get("GSMERGE_FUZZ_EXAMPLES", "20"))
FINDINGS = sorted((Path(__file__).parents[1] / "fuzz" / "findings").glob("*"))


def attempt(reader: str, data: bytes, folder: Path) -> bool:
    folder.mkdir()
    return TARGETS[reader].attempt(data, folder)


@pytest.mark.parametrize("reader", TARGETS)
def test_changed_files_are_read_or_refused(reader: str, tmp_path: Path) -> None:
    seeds, random = seeds_of(TARGETS[reader]), Random(0)
    sound = [attempt(reader, seed, tmp_path / f"seed {i}") for i, seed in enumerate(seeds)]
    assert any(sound)
    for i in range(EXAMPLES):
        attempt(reader, mutate(random.choice(seeds), random), tmp_path / str(i))


@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: path.name)
def test_findings_stay_fixed(path: Path, tmp_path: Path) -> None:
    attempt(path.name.partition(".")[0], path.read_bytes(), tmp_path / "read")
