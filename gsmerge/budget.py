"""How many Gaussians a budget, a file size or a device allows."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import dataclass
from fractions import Fraction

from gsmerge.errors import UsageError
from gsmerge.io.formats.ply_writer import count_for_bytes

PRESETS = {"quest3": 400_000, "mobile": 1_000_000, "desktop": 3_000_000}
SIZES = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


@dataclass(frozen=True)
class TargetOptions:
    """What decides the number of Gaussians, next to the superpixels of each view and K.

    Args:
        budget: Gaussians in the result: a number, or a share of the input as "2%". Met, and never exceeded.
        max_bytes: Largest size of the result as a ``.ply``: bytes, or as "5MB".
        preset: The most that a ``quest3``, a ``mobile`` or a ``desktop`` draws fluidly; scenes that need fewer
            get fewer.
        max_drop: The fewest Gaussians that lose at most this (dB) against the best that the scene's own curve
            reaches.
        target_psnr: The fewest Gaussians with which the input photos are rendered at this PSNR (dB).
        levels: Levels of detail, each with a quarter of the Gaussians of the one before and fitted by itself.

    Raises:
        ValueError: If a setting is out of range, or both quality targets are given.
    """

    budget: int | str | None = None
    max_bytes: int | str | None = None
    preset: str | None = None
    max_drop: float | None = None
    target_psnr: float | None = None
    levels: int = 1

    def __post_init__(self) -> None:
        if self.budget is not None:
            parse_budget(self.budget, sys.maxsize)
        if self.max_bytes is not None:
            parse_bytes(self.max_bytes)
        if self.preset is not None and self.preset not in PRESETS:
            raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {self.preset!r}")
        if self.max_drop is not None and not 0 <= self.max_drop < math.inf:
            raise ValueError(f"max drop: expected at least 0 dB, got {self.max_drop}")
        if self.target_psnr is not None and not 0 < self.target_psnr < math.inf:
            raise ValueError(f"target psnr: expected more than 0 dB, got {self.target_psnr}")
        if self.max_drop is not None and self.target_psnr is not None:
            raise ValueError("expected one of max drop and target psnr, got both")
        if not 1 <= self.levels <= 8:
            raise ValueError(f"levels: expected 1 to 8, got {self.levels}")

    @property
    def searches(self) -> bool:
        """Whether a quality decides the count."""
        return self.max_drop is not None or self.target_psnr is not None


def exact_count(options: TargetOptions, num_input: int, sh_degree: int) -> int | None:
    """The number of Gaussians that a budget or a file size asks for, the smaller of the two; None without either."""
    wanted = []
    if options.budget is not None:
        wanted.append(parse_budget(options.budget, num_input))
    if options.max_bytes is not None:
        wanted.append(count_for_bytes(parse_bytes(options.max_bytes), sh_degree))
    return min(*wanted, num_input) if wanted else None


def most_allowed(options: TargetOptions, num_input: int, sh_degree: int) -> int:
    """The most Gaussians that budget, size and preset leave, at most as many as the input has."""
    limits = [num_input, exact_count(options, num_input, sh_degree), PRESETS.get(options.preset or "")]
    return min(limit for limit in limits if limit is not None)


def parse_budget(budget: str | int, num_input: int) -> int:
    """The number of Gaussians that ``--budget`` asks for: a number, or a share of the input as "2%" (rounded down).

    Never above ``num_input``.

    Raises:
        ValueError: If it is neither, or more than the input.
        UsageError: If it is not at least one Gaussian.

    Example:
        >>> parse_budget("40000", 1_000_000), parse_budget("2.5%", 1_000_000)
        (40000, 25000)
    """
    text = str(budget).strip()
    found = re.fullmatch(r"(\d[\d_]*|\d*\.?\d+\s*%)", text, re.ASCII)
    if not found:
        raise ValueError(f'budget: expected a number of Gaussians as "40000" or a share as "2%", got {text!r}')
    if text.endswith("%"):
        share = Fraction(text[:-1].strip())
        if share > 100:
            raise ValueError(f"budget: expected at most 100%, got {text!r}")
        count = int(share * num_input / 100)
    else:
        count = min(int(text), num_input)
    if count < 1:
        raise UsageError(f"budget: expected at least one Gaussian, got {text!r}")
    return count


def parse_bytes(size: str | int) -> int:
    """The number of bytes of a size as "5MB", "800 KiB" or "5000000".

    Raises:
        ValueError: If it is none.

    Example:
        >>> parse_bytes("1.5MB")
        1500000
    """
    text = str(size).strip()
    found = re.fullmatch(r"(\d*\.?\d+)\s*([A-Za-z]*)", text, re.ASCII)
    unit = SIZES.get((found[2] or "B").upper()) if found else None
    if found is None or unit is None:
        raise ValueError(f'max bytes: expected a size as "5MB" or "800KiB", got {text!r}')
    return int(Fraction(found[1]) * unit)
