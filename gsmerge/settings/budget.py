"""Declare the settings that decide the number of Gaussians, and parse their texts.

A user gives a number, a share of the input, a file size, a device or a quality.
"""

from __future__ import annotations

import math
import re
import sys
from decimal import Decimal
from fractions import Fraction

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass
from gsmerge.settings.setting import Settings, setting, suggest_name

UNIT_BYTES = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
AUTO = "auto"
COUNT_PATTERN = r"\d[\d_]*|\d{1,3}(?:,\d{3})+|\d*\.?\d+(?:k|m|e\d)"  # such as 40000, 40_000, 40,000, 40k or 4e4
DEVICES = {"quest3": 400_000, "mobile": 1_000_000, "desktop": 3_000_000}  # Gaussians that a device draws fluidly


@dataclass(frozen=True)
class BudgetOptions(Settings):
    """Settings that decide the number of Gaussians, besides `superpixels` and `k`."""

    budget: int | str | None = setting(None, "Number of Gaussians in the result. A number such as 40000 is met "
        "exactly. Upper limits are a share of the input such as 2%, a file size such as 5MB, or a device that draws "
        "them fluidly: quest3, mobile or desktop. auto: as many as the scene needs.",
        "The file size is that of the output, in Python that of a `.ply`, and is never exceeded. A limit is used only "
        "as far as new views gain from more Gaussians, unless `fill` is true.", as_text=True)  # fmt: skip
    fill: bool = setting(False, "Use all of a share, file size or device, even if fewer Gaussians suffice.")
    most: int | None = setting(None, "Number of Gaussians beyond which new views gain nothing, if known.",
        internal=True)  # fmt: skip
    quality: str | None = setting(None, "Use the fewest Gaussians that reach a target on photos: a PSNR such as 30dB, "
        "or a loss against the best number of Gaussians such as -0.2dB (in PSNR + 40 SSIM).",
        "The photos are held out if there are four or more, otherwise they are those of the input. If the rows belong "
        "to no pixels and no number is asked for, the result keeps the quality of the input. Without photos it "
        "reaches 32.5 dB against renders of the input; with photos it loses at most 0.3 dB on them.")  # fmt: skip
    keep: bool = setting(False, "Use as many Gaussians as keep the quality of the input.", internal=True)
    output: str = setting(
        "", "Name of the output file, with its ending. A file size as `budget` counts its bytes.", internal=True
    )
    levels: int = setting(1, "Number of levels of detail. Each level has a quarter of the Gaussians of the one before. "
        "They are written to one file each, or all to a lod-meta.json.",
        "Each level is fitted on its own.", least=1, most=8)  # fmt: skip

    def __post_init__(self) -> None:
        if self.quality is not None:
            parse_quality(self.quality)
        if isinstance(self.budget, float):  # the error says which share may be meant
            parse_budget(str(self.budget), sys.maxsize)
        super().__post_init__()
        word = str(self.budget).strip().lower()
        if word in (AUTO, *DEVICES):
            object.__setattr__(self, "budget", word)
        elif self.in_bytes:
            parse_bytes(str(self.budget))
        elif self.budget is not None:
            parse_budget(self.budget, sys.maxsize)

    @property
    def search_names(self) -> list[str]:
        """Names of the settings in use for which several results have to be built and compared."""
        requests = {"budget auto": self.auto, "levels": self.levels > 1, f"quality {self.quality}": self.quality}
        return [name for name, is_asked in requests.items() if is_asked]

    @property
    def leaves_open(self) -> bool:
        """True if the scene decides the number of Gaussians, without a limit or up to the limit of a device."""
        return self.budget in (None, AUTO, *DEVICES)

    @property
    def auto(self) -> bool:
        """True if the user asks for as many Gaussians as the scene needs."""
        return self.budget == AUTO

    @property
    def is_limit(self) -> bool:
        """True if the budget is a share, a size or a device, and a run uses only as much of it as improves new
        views."""
        return not self.fill and not self.auto and self.budget is not None and self.number is None

    @property
    def is_filled(self) -> bool:
        """True if the result has all Gaussians of the budget, even if no view sees some of them."""
        return self.number is not None or self.fill

    @property
    def number(self) -> int | None:
        """The number of Gaussians if the budget is a number; None for any other budget, or without a budget."""
        if self.budget is None or self.auto or self.in_bytes or self.budget in DEVICES or "%" in str(self.budget):
            return None
        return parse_budget(self.budget, sys.maxsize)

    @property
    def in_bytes(self) -> bool:
        """True if the budget is a file size."""
        return re.fullmatch(r"[^a-z]*[kmg]?i?b", str(self.budget).strip().lower()) is not None

    @property
    def target_psnr(self) -> float | None:
        """PSNR (dB) that the result has to reach; None if the user asks for none."""
        quality = None if self.quality is None else parse_quality(self.quality)
        return None if quality is None or self.max_drop is not None else quality

    @property
    def max_drop(self) -> float | None:
        """Largest loss (dB) against the best number of Gaussians on the scene's curve; None if the user gives none."""
        is_loss = self.quality is not None and self.quality.strip().startswith("-")
        return -parse_quality(str(self.quality)) if is_loss else None


def parse_quality(text: str) -> float:
    """Parse a PSNR such as "30dB", or a loss such as "-0.2dB", into a number of dB; a loss is negative.

    Example:
        >>> parse_quality("30dB"), parse_quality("-0.2dB")
        (30.0, -0.2)
    """
    match = re.fullmatch(r"(-?)(\d*\.?\d+)\s*db", str(text).strip().lower(), re.ASCII)
    value = float(match[2]) if match else math.inf
    grey_psnr = 6.0  # PSNR (dB) that a grey picture reaches on any photo, so a smaller target is a mistake
    if match is None or not math.isfinite(value) or (value < grey_psnr and not match[1]):
        number = float(text) if re.fullmatch(r"-?\d*\.?\d+", str(text), re.ASCII) else math.inf
        usual = 50  # dB; hardly any result reaches more
        hint = f'; perhaps "{text}dB"' if number <= usual else ""
        hint = f"; a PSNR is usually 20 to 40 dB, and none reaches {text}" if usual < number < math.inf else hint
        hint = f'; perhaps "-{value:g}dB"' if match is not None and 0 < value < grey_psnr else hint
        raise ValueError(f'quality: expected a PSNR as "30dB" or a loss as "-0.2dB", got {text!r}{hint}')
    return -value if match[1] else value


def parse_share(text: str) -> float:
    """Parse a share such as "4.4%" into a number such as 0.044.

    Raises ValueError unless the share is above 0 and at most 1.
    """
    match = re.fullmatch(r"(\d*\.?\d+)\s*%", str(text).strip(), re.ASCII)
    share = Fraction(match[1]) / 100 if match else Fraction(0)
    if not 0 < share <= 1:
        raise ValueError(f'expected a share as "4.4%", above 0 and up to 100%, got {text!r}')
    return float(share)


def share_text(share: float) -> str:
    """Format a share such as 0.044 as a text such as "4.4%", which :func:`parse_share` parses into the same number."""
    if isinstance(share, bool) or not isinstance(share, int | float):
        raise ValueError(f"expected a share as a number, got {share!r}")
    return f"{(Decimal(repr(share)) * 100).normalize():f}%"


def parse_budget(budget: str | int | None, num_input: int) -> int:
    """Parse a number of Gaussians such as "40000", "40k" or "1e5", or a share of the input such as "2%".

    Returns:
        At most ``num_input`` Gaussians.

    Raises:
        ValueError: If the text is neither a number nor a share.
        UsageError: If the result is less than one Gaussian.

    Example:
        >>> parse_budget("40000", 1_000_000), parse_budget("2.5%", 1_000_000)
        (40000, 25000)
    """
    text = str(budget).strip()
    match = re.fullmatch(rf"(?:{COUNT_PATTERN})|(\d*\.?\d+)\s*%", text, re.ASCII | re.IGNORECASE)
    if not match:
        is_fraction = re.fullmatch(r"\d*\.\d+", text, re.ASCII) is not None
        percent = float(text) if is_fraction else 0.0
        percent *= 100 if percent < 1 else 1
        hint = f'; perhaps "{percent:g}%"' if 0 < percent <= 100 else suggest_name(text, (AUTO, *DEVICES))
        hint = f"; --quality {text} asks for a PSNR" if text.lower().endswith("db") else hint
        raise ValueError(
            f'budget: expected a number of Gaussians as "40000", a share as "2%", a size as "5MB", auto or'
            f" {', '.join(DEVICES)}, got {text!r}{hint}"
        )
    if match[1]:
        share = Fraction(match[1])
        if share > 100:
            raise ValueError(f"budget: expected at most 100%, got {text!r}")
        count = int(share * num_input / 100)
    else:
        plain = re.sub("[,_]", "", text.lower()).replace("k", "e3").replace("m", "e6")
        count = min(int(Fraction(plain)), num_input)
    if count < 1:
        raise UsageError(f"budget: expected at least one Gaussian, got {text!r}")
    return count


def parse_bytes(size: str | int) -> int:
    """Parse a file size such as "5MB", "800 KiB" or "5000000" into bytes.

    Example:
        >>> parse_bytes("1.5MB")
        1500000
    """
    text = str(size).strip()
    match = re.fullmatch(r"(\d*\.?\d+)\s*([A-Za-z]*)", text, re.ASCII)
    unit = UNIT_BYTES.get((match[2] or "B").upper()) if match else None
    if match is None or unit is None:
        raise ValueError(f'budget: expected a size as "5MB" or "800KiB", got {text!r}')
    return int(Fraction(match[1]) * unit)
