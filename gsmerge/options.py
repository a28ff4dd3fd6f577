"""All settings of a run: the stages' options in one place, by flat names."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from gsmerge.allocate import AllocateOptions, parse_budget, parse_bytes
from gsmerge.backing import BackingOptions
from gsmerge.contribution import ContributionOptions
from gsmerge.decode import DecodeOptions
from gsmerge.encode import EncodeOptions
from gsmerge.fit import FitOptions
from gsmerge.match import MatchOptions
from gsmerge.robust import RobustOptions
from gsmerge.segment import SegmentOptions


@dataclass(frozen=True)
class CompactOptions:
    """Every setting of :func:`gsmerge.compact`, stage by stage.

    Args:
        segment: Superpixels.
        allocate: How a budget is spread over the views.
        contribution: Gaussians that are not one per pixel.
        encode: How a group becomes one Gaussian.
        robust: Choice among merges by the photos.
        backing: The coarse layer that the choice may add.
        match: Merging across views.
        decode: Gaussians per group.
        fit: Fit to the photos.
        budget: Gaussians in the result: a number, or a share of the input as "2%". Met, and never exceeded.
        max_bytes: Largest size of the result as a ``.ply``: bytes, or as "5MB".
        seed: Everything random hangs on it; runs with one seed are bit-identical.
        threads: Threads to use; None: all processors. The result does not depend on it.

    Raises:
        ValueError: If the budget or the size cannot be read.
    """

    segment: SegmentOptions = field(default_factory=SegmentOptions)
    allocate: AllocateOptions = field(default_factory=AllocateOptions)
    contribution: ContributionOptions = field(default_factory=ContributionOptions)
    encode: EncodeOptions = field(default_factory=EncodeOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    backing: BackingOptions = field(default_factory=BackingOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    decode: DecodeOptions = field(default_factory=DecodeOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    budget: int | str | None = None
    max_bytes: int | str | None = None
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.budget is not None:
            parse_budget(self.budget, sys.maxsize)
        if self.max_bytes is not None:
            parse_bytes(self.max_bytes)

    def to_dict(self) -> dict[str, Any]:
        """All settings by their flat names, as plain values."""
        flat: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            flat.update(asdict(value) if is_dataclass(value) and not isinstance(value, type) else {f.name: value})
        return flat

    def with_settings(self, settings: Mapping[str, Any]) -> CompactOptions:
        """The options with some settings changed, by flat name (``k=2, density=0.01``).

        Raises:
            ValueError: If a name is unknown.
        """
        changes: dict[str, Any] = {}
        left = dict(settings)
        for f in fields(self):
            value = getattr(self, f.name)
            if is_dataclass(value) and not isinstance(value, type):
                own = {g.name: left.pop(g.name) for g in fields(value) if g.name in left}
                changes[f.name] = replace(value, **own)
            elif f.name in left:
                changes[f.name] = left.pop(f.name)
        if left:
            raise ValueError(f"unknown setting {sorted(left)[0]!r}; known: {', '.join(sorted(self.to_dict()))}")
        return replace(self, **changes)
