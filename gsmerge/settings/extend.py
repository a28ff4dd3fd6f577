"""Settings for adding a batch of new views to a state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.settings.setting import Settings, flat_settings, setting
from gsmerge.settings.stages import MAX_CHILDREN

SUFFIX = ".gsm"  # of the file of a state

# Settings of this module under the name of a recipe, see gsmerge.settings.compact.RECIPES
RECIPES: Mapping[str, Mapping[str, Any]] = {"paper": {"tolerance": 0.0, "replay": 0}}


@dataclass(frozen=True)
class ExtendOptions(Settings):
    """Settings of how new views enter a state."""

    max_k: int | None = setting(None, "Most Gaussians per superpixel that can be decoded later: fixed by the first "
        "batch. More take more space.",
        "By default 4; 8 where `k` is larger, or a number of Gaussians is asked for.", least=1, most=MAX_CHILDREN,
        shown="4, or 8 with a --budget")  # fmt: skip
    tolerance: float = setting(0.06, "Leave out a new group where the state shows its pixels with a colour error (root "
        "mean square, sRGB in [0, 1], holes counted) below this, or no larger than `margin` times that of the new "
        "views' own Gaussians.",
        "0: nothing is left out.", least=0, most=1)  # fmt: skip
    margin: float = setting(1.0, "See `tolerance`.", least=0, most=1000)
    replay: int = setting(96, "Most photos that are stored, spread evenly over all views, for a full fit when "
        "decoding.",
        "Colours are fitted batch by batch and need none.", least=0)  # fmt: skip
    fit_colors: bool = setting(True, "Fit the base colours to the photos of each batch; not of groups that keep their "
        "latents, whose colours are those of the heads.")  # fmt: skip


def own_settings(stored: Mapping[str, Any], *, has_networks: bool) -> dict[str, Any]:
    """Return the settings of a state's file that may decide something, each of its type and within its range.

    Left out are unknown ones, the threads, and the path of a checkpoint, which stays as a name alone where the state
    has the networks itself. Raises ValueError for others that are not allowed.
    """
    declared = flat_settings(CompactOptions) | flat_settings(ExtendOptions)
    own = {name: value for name, value in stored.items() if name in declared and name != "threads"}
    for name, value in own.items():
        if not declared[name].fits(value):
            raise ValueError(f"{name}: expected {declared[name].expected(value)}, got {value!r:.40}")
    if not has_networks and own.get("checkpoint", "none") not in CHECKPOINTS:
        del own["checkpoint"]
    merge_settings({}, own)
    return own


def merge_settings(
    settings: Mapping[str, Any], stored: Mapping[str, Any] | None = None
) -> tuple[CompactOptions, ExtendOptions]:
    """Combine settings: those given, else those stored in a state, else the defaults without a full fit."""
    names = ExtendOptions.__dataclass_fields__.keys()
    all_names = names | CompactOptions().to_dict().keys()
    before = {name: value for name, value in (stored or {}).items() if name in all_names}
    recipe = settings.get("recipe", before.get("recipe"))
    merged = {"fit": "none"} | dict(RECIPES.get(str(recipe), {})) | before | dict(settings)
    extend_options = ExtendOptions(**{name: merged.pop(name) for name in names if name in merged})
    return CompactOptions().with_settings(merged), extend_options
