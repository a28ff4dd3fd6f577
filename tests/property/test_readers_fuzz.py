"""Every reader on changed files: an answer or an error of the package, nothing else; python tasks.py fuzz tries more.

``GSMERGE_FUZZ_EXAMPLES`` sets how many files each reader tries.
"""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

import pytest
from damage import SOUNDS
from damage.random_changes import FINDINGS, mutate

EXAMPLES = int(os.environ.get("GSMERGE_FUZZ_EXAMPLES", "20"))
FUZZED = [kind for kind, sound in SOUNDS.items() if sound.fuzzed]


def attempt(kind: str, data: bytes, folder: Path) -> bool:
    folder.mkdir()
    return SOUNDS[kind].attempt(data, folder)


@pytest.mark.parametrize("kind", FUZZED)
def test_changed_files_are_read_or_refused(kind: str, tmp_path: Path) -> None:
    content, random = SOUNDS[kind].content(), Random(0)
    assert attempt(kind, content, tmp_path / "sound")
    for i in range(EXAMPLES // 2 if SOUNDS[kind].rare else EXAMPLES):
        attempt(kind, mutate(content, random), tmp_path / str(i))


def test_files_that_once_failed_are_read_or_refused(tmp_path: Path) -> None:
    """Files that the fuzzer has kept; there may be none."""
    for path in sorted(FINDINGS.glob("*")):
        attempt(path.name.rpartition(".")[0], path.read_bytes(), tmp_path / path.name)
