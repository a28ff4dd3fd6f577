"""Type checkers and editors know the settings of functions by name, with their types."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

from gsmerge import CompactOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.keywords import BatchSettings, CompactSettings
from gsmerge.settings.setting import flat_settings

CALLS = """
import gsmerge
gsmerge.compact("room", budget="2%", k=2, fit="none")
gsmerge.compact("room", budgte="2%")
gsmerge.compact("room", fit="nothing")
gsmerge.Compactor(max_views=3, effort="draft").compact(levels=2)
gsmerge.Compactor(maxviews=3)
"""


def test_settings_have_the_types_of_their_fields() -> None:
    declared = {name: setting.kind for name, setting in flat_settings(CompactOptions).items()}
    assert get_type_hints(CompactSettings) == declared
    added = {name: setting.kind for name, setting in flat_settings(ExtendOptions).items()}
    assert get_type_hints(BatchSettings) == declared | added


@pytest.mark.slow  # mypy reads the package, which takes half a minute
def test_a_type_checker_refuses_settings_that_do_not_exist(tmp_path: Path) -> None:
    (tmp_path / "calls.py").write_text(CALLS)
    call = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", str(tmp_path / "calls.py")]
    lines = subprocess.run(call, capture_output=True, text=True, check=False).stdout.splitlines()
    wrong = {line.split(":")[1] for line in lines if line.startswith(str(tmp_path)) and ": error: " in line}
    assert wrong == {"4", "5", "7"}
