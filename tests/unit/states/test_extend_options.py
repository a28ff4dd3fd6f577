"""Settings: what is refused, and where those that are not given come from."""

from __future__ import annotations

import pytest
from messages import refuses

from gsmerge import Compactor
from gsmerge.settings.extend import ExtendOptions
from gsmerge.states.compactor import merge_settings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_k", 0), ("max_k", 9), ("tolerance", -0.1), ("tolerance", 1.1), ("tolerance", float("nan")),
        ("margin", -1.0), ("margin", float("nan")), ("replay", -1),
    ],
)  # fmt: skip
def test_settings_out_of_range(name: str, value: float) -> None:
    for use in (ExtendOptions, Compactor):
        with refuses(ValueError, name, value):
            use(**{name: value})


def test_colours_are_fitted_unless_told_otherwise() -> None:
    options, online = merge_settings({})
    assert options.fit.fit == "none"
    assert online == ExtendOptions()
    assert online.fit_colors
    assert not merge_settings({"fit_colors": False})[1].fit_colors


def test_the_state_s_settings_come_before_the_defaults() -> None:
    said = {"superpixels": "7%", "fit_colors": False, "tolerance": 0.2, "threads": 3, "of another version": 5}
    options, online = merge_settings({"tolerance": 0.3, "seed": 4}, said)
    assert options.to_dict().items() >= {"superpixels": "7%", "seed": 4}.items()
    assert (online.tolerance, online.fit_colors) == (0.3, False)
