"""Declare the settings of ``gsmerge extend``, which adds a batch of views to a state.

A state is a file to which further views can be added, and from which a result can be made at any time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsmerge.frozen import dataclass
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.setting import Settings, setting


@dataclass(frozen=True)
class ExtendOptions(Settings):
    """Settings for adding new views to a state."""

    max_views: int = setting(96, "Largest number of views whose pictures a state keeps for the fit when it is "
        "compacted. The views farthest apart are kept.",
        "A picture takes three bytes per pixel.", least=1, most=10_000)  # fmt: skip
    other_world: bool = setting(False, "Add a batch even if its pictures do not show the Gaussians of earlier batches, "
        "because its frame of coordinates is another one.", "Otherwise such a batch is refused.")  # fmt: skip


def batch_settings(settings: Mapping[str, Any]) -> tuple[CompactOptions, ExtendOptions]:
    """Make the options for adding a batch of views, from settings by flat name; the default effort is "draft".

    Raises ValueError for an unknown setting, and for several levels of detail.
    """
    names = ExtendOptions.__dataclass_fields__.keys()
    values = {"effort": "draft"} | dict(settings)
    extend_options = ExtendOptions(**{name: values.pop(name) for name in names if name in values})
    options = CompactOptions().with_settings(values)
    if options.budget.levels > 1:
        raise ValueError("levels: not possible for views that are added in batches; use compact on the whole scene")
    return options, extend_options
