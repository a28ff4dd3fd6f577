"""Sizes of the networks, and how far their outputs may go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any


def _expect_number(name: str, value: Any, maximum: float) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= maximum:
        raise ValueError(f"{name}: expected a number from 0 to {maximum:g}, got {value!r}")


def _expect_count(name: str, value: Any, maximum: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= maximum:
        raise ValueError(f"{name}: expected a whole number from 1 to {maximum}, got {value!r}")


@dataclass(frozen=True)
class Bounds:
    """Largest correction that the decoder may make, 0: none; merger, refiner and encoder may each make half of it.

    Args:
        mean: Shift along each axis of the group's frame, in units of the Gaussian's size.
        size: Change of each log scale.
        turn: Rotation about each axis of the group's frame, radians.
        logit: Change of the opacity's logit; of Feature Gaussians, of the logarithm of the optical depth.
        color: Change of each channel of the base colour, sRGB in [0, 1].

    Raises:
        ValueError: If one is below 0, or too large to bound anything.
    """

    mean: float = 1.0
    size: float = 1.1
    turn: float = 0.5
    logit: float = 3.0
    color: float = 0.25

    def __post_init__(self) -> None:
        for f in fields(self):
            _expect_number(f.name, getattr(self, f.name), 8.0)


WIDE = Bounds(mean=4.0, size=6.0, turn=3.2, logit=8.0, color=0.75)  # of absolute outputs
OUTPUTS = ("residual", "absolute")


@dataclass(frozen=True)
class NetworkOptions:
    """Sizes of the networks, and the kind of their heads' output.

    Args:
        width: Width of the tokens, a multiple of ``heads``.
        heads: Attention heads.
        blocks: Set attention blocks of the encoder and of the merger.
        refine_blocks: Attention blocks of the refiner.
        latent: Width of a Feature Gaussian's latent.
        members: Largest number of members that the encoder reads; larger groups are sampled.
        neighbors: Neighbours that the refiner reads.
        bounds: Largest corrections.
        outputs: ``"residual"``: the heads correct the analytic children. ``"absolute"``, as in the paper: they do not
            read these, and correct a round Gaussian of the group's mean and base colour, within wide bounds.
        encoder: Whether there is one; without it all latents are zero.
        merger: Whether there is one; without it clusters are pooled, and no more.
        refiner: Whether there is one.

    Raises:
        ValueError: If a size is out of range or they do not go together.
    """

    width: int = 48
    heads: int = 4
    blocks: int = 1
    refine_blocks: int = 2
    latent: int = 32
    members: int = 16
    neighbors: int = 8
    bounds: Bounds = field(default_factory=Bounds)
    outputs: str = "residual"
    encoder: bool = True
    merger: bool = True
    refiner: bool = True

    @property
    def head_bounds(self) -> Bounds:
        """Largest corrections of the heads."""
        return WIDE if self.outputs == "absolute" else self.bounds

    def __post_init__(self) -> None:
        if self.outputs not in OUTPUTS:
            raise ValueError(f"outputs: expected {' or '.join(OUTPUTS)}, got {self.outputs!r}")
        limits = {"width": 512, "heads": 16, "blocks": 8, "refine_blocks": 8, "latent": 256, "members": 256}
        for name, limit in (limits | {"neighbors": 64}).items():
            _expect_count(name, getattr(self, name), limit)
        for name in ("encoder", "merger", "refiner"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: expected true or false, got {getattr(self, name)!r}")
        if self.width % self.heads:
            raise ValueError(f"width: expected a multiple of {self.heads} heads, got {self.width}")

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> NetworkOptions:
        """The options that ``dataclasses.asdict`` gave.

        Raises:
            ValueError: If a name is unknown or a value out of range.
        """
        unknown = sorted(values.keys() - {f.name for f in fields(NetworkOptions)})
        bounds = values.get("bounds", {})
        if not isinstance(bounds, Mapping):
            raise ValueError(f"bounds: expected a table, got {bounds!r}")
        unknown += sorted(bounds.keys() - {f.name for f in fields(Bounds)})
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}")
        return NetworkOptions(**{**values, "bounds": Bounds(**bounds)})
