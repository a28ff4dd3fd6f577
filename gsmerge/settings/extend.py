"""Settings for adding a batch of new views to a state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gsmerge.settings.compact import CompactOptions, changed_settings
from gsmerge.settings.setting import Settings, setting

SUFFIX = ".gsm"  # of the file of a state


@dataclass(frozen=True)
class ExtendOptions(Settings):
    """Settings of how new views enter a state."""

    max_views: int = setting(96, "Most views that a state keeps with their pictures, the farthest apart, for the fit "
        "when it is compacted.",
        "Three bytes per pixel of each.", least=1, most=10_000)  # fmt: skip
    other_world: bool = setting(False, "Add a batch though its pictures do not show the Gaussians of earlier batches, "
        "as in another world.", "Without it such a batch is refused.")  # fmt: skip


def batch_settings(settings: Mapping[str, Any]) -> tuple[CompactOptions, ExtendOptions]:
    """Make the settings of a batch: those given, else those of a draft; raise ValueError for unknown ones."""
    names = ExtendOptions.__dataclass_fields__.keys()
    given = {"effort": "draft"} | dict(settings)
    extend_options = ExtendOptions(**{name: given.pop(name) for name in names if name in given})
    options = CompactOptions().with_settings(given)
    for name in changed_settings(options, lambda one: not one.in_batches):
        raise ValueError(f"{name}: go with a whole scene, not with views that come one after the other; use compact")
    return options, extend_options
