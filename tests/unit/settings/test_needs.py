"""Settings ask of a run one piece, all views, or a number of Gaussians."""

from __future__ import annotations

import pytest

from gsmerge import CompactOptions
from gsmerge.settings.compact import ONE_PIECE, TRIAL


@pytest.mark.parametrize("values", [ONE_PIECE, TRIAL])
def test_values_for_parts_of_a_scene_are_possible(values: dict[str, object]) -> None:
    assert CompactOptions().with_settings(values).to_dict().items() >= values.items()


def test_settings_that_need_the_scene_in_one_piece_are_named() -> None:
    asked = {"method": "greedy", "budget": 100, "crop": "sphere:0,0,0,1", "drop": "floaters, unseen"}
    named = CompactOptions().with_settings(asked).whole_only
    assert set(named) == {"method greedy", "crop", "drop floaters", "drop unseen"}
    levels = CompactOptions().with_settings({"levels": 2, "quality": "30dB"})
    assert set(levels.whole_only) == {"levels", "quality 30dB"}
    assert CompactOptions().whole_only == CompactOptions().uncut == []
    uncut = CompactOptions().with_settings({"budget": "auto", "poses": "free", "exposure": "per-photo"})
    assert set(uncut.uncut) == {"budget auto", "poses free", "exposure per-photo"}
    assert uncut.whole_only == []


def test_settings_tell_whether_the_scene_decides_the_count() -> None:
    def decides(**settings: object) -> tuple[bool, bool, bool]:
        options = CompactOptions().with_settings(settings)
        return options.scene_decides, options.replaces_stages, options.changes_superpixels

    assert decides() == decides(budget="auto") == decides(budget="mobile") == decides(checkpoint="none")
    assert decides() == (True, False, False)
    assert decides(budget=100) == decides(k=2) == decides(superpixels="2%") == decides(quality="30dB")
    assert decides(budget=100) == (False, False, False)
    assert decides(checkpoint="shipped") == (False, True, False)
    assert decides(match="none") == decides(compactness=0.1) == decides(k_low=20.0) == (True, False, True)
