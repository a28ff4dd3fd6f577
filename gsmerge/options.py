"""All settings of a run: the stages' options in one place, by flat names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from gsmerge.allocate import AllocateOptions
from gsmerge.backing import BackingOptions
from gsmerge.contribution import ContributionOptions
from gsmerge.decode import DecodeOptions
from gsmerge.encode import EncodeOptions
from gsmerge.fit import FitOptions
from gsmerge.match import MatchOptions
from gsmerge.robust import RobustOptions
from gsmerge.segment import SegmentOptions
from gsmerge.targets import TargetOptions


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
        target: What decides the number of Gaussians.
        seed: Everything random hangs on it; on the CPU, runs with one seed are bit-identical.
        threads: Threads to use; None: all processors. The result does not depend on it.
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
    target: TargetOptions = field(default_factory=TargetOptions)
    seed: int = 0
    threads: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """All settings by their flat names, as plain values."""
        flat: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            flat.update(asdict(value) if is_dataclass(value) and not isinstance(value, type) else {f.name: value})
        return flat

    def with_settings(self, settings: Mapping[str, Any]) -> CompactOptions:
        """The options with some settings changed, by flat name (``k=2, density=0.01``).

        A name that several stages share, such as ``effort``, is changed in all of them.

        Raises:
            ValueError: If a name is unknown.
        """
        changes: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if is_dataclass(value) and not isinstance(value, type):
                changes[f.name] = replace(
                    value, **{g.name: settings[g.name] for g in fields(value) if g.name in settings}
                )
            elif f.name in settings:
                changes[f.name] = settings[f.name]
        unknown = sorted(settings.keys() - self.to_dict().keys())
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}; known: {', '.join(sorted(self.to_dict()))}")
        return replace(self, **changes)
