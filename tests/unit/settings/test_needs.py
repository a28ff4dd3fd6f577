"""What declarations say of settings beside their values: lists that runs of parts and of baselines go by."""

from __future__ import annotations

from gsmerge import CompactOptions
from gsmerge.compaction.methods import COUNTS
from gsmerge.settings.setting import names_of, piece_settings


def test_lists_are_those_of_the_declarations() -> None:
    assert set(COUNTS) == {"budget", "superpixels", "k"}
    common = names_of(CompactOptions, lambda one: one.common)
    assert set(common) == {"method", "seed", "threads", "crop", "drop"}
    assert set(names_of(CompactOptions, lambda one: one.whole)) == {"method", "levels", "quality", "crop", "drop"}


def test_a_part_leaves_to_the_whole_what_the_whole_decides() -> None:
    """A block or a batch, and a trial, which also leaves out what only the result has."""
    part = {"poses": "fixed", "exposure": "fixed", "blocks": "none", "new_views": False}
    only = {"budget": None, "quality": None, "levels": 1, "crop": None, "drop": None}
    assert piece_settings(CompactOptions) == part
    trial = part | only | {"photo_scale": 1.0, "recipe": None}
    assert piece_settings(CompactOptions, trial=True) == trial
    CompactOptions().with_settings(trial)  # all are values that the settings take


def test_settings_that_need_the_scene_in_one_piece_are_named() -> None:
    asked = {"method": "voxel", "budget": 100, "crop": "sphere:0,0,0,1", "drop": "floaters, unseen"}
    named = CompactOptions().with_settings(asked).whole_only
    assert set(named) == {"method voxel", "crop", "drop floaters", "drop unseen"}
    assert set(CompactOptions().with_settings({"levels": 2, "quality": "30dB"}).whole_only) == {
        "levels",
        "quality 30dB",
    }
    assert CompactOptions().whole_only == CompactOptions().uncut == []
    uncut = CompactOptions().with_settings({"budget": "auto", "poses": "free", "exposure": "per-photo"})
    assert set(uncut.uncut) == {"budget auto", "poses free", "exposure per-photo"}
    assert uncut.whole_only == []
