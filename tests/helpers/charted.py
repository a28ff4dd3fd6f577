"""A folder of ``gsmerge lab chart`` is drawn once in a run, since drawing takes seconds."""

from __future__ import annotations

from pathlib import Path

import pytest
from batches import InlinePool
from shared import make_once, write_scene

from gsmerge.cli import main

CHART_TARGETS = ("--targets", "{parent}/targets/transforms.json")
CHART_FAST = ("--grid", "budget=1%,2%", "--set", "fit=none", "--set", "lpips=none")


def charted_scene() -> Path:
    """Return a folder with a scene ``room``, and ``out`` with the charts of two merges. Read only."""
    return make_once("charted", _write)


def _write(place: Path) -> None:
    scene = write_scene(place / "room", num_views=3, width=64, height=48)
    words = ("lab", "chart", scene, "-o", place / "out", *CHART_TARGETS, *CHART_FAST, "-q")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsmerge.jobs.batch.run.ProcessPool", InlinePool)
        assert main([str(word) for word in words]) == 0
