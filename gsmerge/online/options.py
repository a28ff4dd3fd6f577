"""Settings for adding a batch of new views to a state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gsmerge.encoded.encoded import StoredScene
from gsmerge.options import CompactOptions
from gsmerge.stages.decode import MAX_CHILDREN

# Settings of this module under the name of a recipe, see gsmerge.options.RECIPES
RECIPES: Mapping[str, Mapping[str, Any]] = {"paper": {"tolerance": 0.0, "replay": 0}}


@dataclass(frozen=True)
class OnlineOptions:
    """Options of the way in which new views enter a state.

    Args:
        max_k: Most Gaussians of a group that can be decoded later, 1 to 8; an existing state keeps its own.
        tolerance: A new group is left out where the state shows its pixels with a colour error (root mean square,
            sRGB in [0, 1], holes counted) below this, or no larger than ``margin`` times that of the new views' own
            Gaussians. 0: nothing is left out, which is what the recipe ``"paper"`` sets.
        margin: See ``tolerance``.
        replay: Most photos that are stored, spread evenly over all views, for a full fit when decoding. Colours are
            fitted batch by batch and need none. The recipe ``"paper"`` sets 0: it has no fit.
        fit_colors: Fit the base colours to the photos of each batch; not of groups that keep their latents, whose
            colours are those of the heads.

    Raises:
        ValueError: If a setting is out of range.
    """

    max_k: int = 4
    tolerance: float = 0.06
    margin: float = 1.0
    replay: int = 96
    fit_colors: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.max_k <= MAX_CHILDREN:
            raise ValueError(f"max k: expected 1 to {MAX_CHILDREN}, got {self.max_k}")
        if not 0 <= self.tolerance <= 1:
            raise ValueError(f"tolerance: expected 0 to 1, got {self.tolerance}")
        if not self.margin >= 0:
            raise ValueError(f"margin: expected at least 0, got {self.margin}")
        if self.replay < 0:
            raise ValueError(f"replay: expected at least 0, got {self.replay}")


def merge_settings(
    settings: Mapping[str, Any], state: StoredScene | None = None
) -> tuple[CompactOptions, OnlineOptions]:
    """Merge settings: given, else those of the state, else the defaults, without a full fit."""
    names = OnlineOptions.__dataclass_fields__.keys()
    known = names | CompactOptions().to_dict().keys()
    stored = {} if state is None else state.about["options"]
    before = {name: value for name, value in stored.items() if name in known}
    recipe = settings.get("recipe", before.get("recipe"))
    merged = {"fit": "none"} | dict(RECIPES.get(str(recipe), {})) | before | dict(settings)
    online = OnlineOptions(**{name: merged.pop(name) for name in names if name in merged})
    return CompactOptions().with_settings(merged), online
