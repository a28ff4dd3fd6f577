"""Settings of synthetic scenes, and the values that one scene draws from them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_table
from gsmerge.research.generate.paths import PATHS
from gsmerge.research.generate.styles import STYLES

Range = tuple[float, float]
MIXED = "mixed"
ERRORS = (  # ranges that --noise scales; the others are habits of the exporter
    *("view_bias", "drift", "patches", "patch_error", "grain", "bleed", "floaters", "turn", "shift"),
    *("exposure", "tint", "oversized", "tilt"),
)
SPREAD = ("view_bias", "drift", "grain", "turn", "shift", "unit")  # drawn uniformly in their logarithm
POSITIVE = (*SPREAD, "far", "scale", "bleed_width", "flatness", "blur")


@dataclass(frozen=True)
class NoiseOptions:
    """Ranges of every error and habit of an exporter, from which each scene draws its values.

    Depth errors are deviations of the logarithm of depth, so about parts of the depth. docs/internals/generator.md
    compares them with real exports. A ValueError if a range is empty or impossible.
    """

    view_bias: Range = (0.0002, 0.02)  # scale error of a view
    drift: Range = (0.0003, 0.02)  # slow error across a view
    patches: Range = (0.0, 0.3)  # share of a view whose depth is wrong
    patch_error: Range = (0.02, 0.5)  # error of these patches
    grain: Range = (0.0007, 0.003)  # independent error of each pixel
    blank: Range = (0.0, 3.0)  # factor of additional errors where the photo has no texture
    bleed: Range = (0.1, 1.0)  # blend towards a smoothed inverse depth at edges, 0 to 1
    bleed_width: Range = (0.6, 1.8)  # deviation of that smoothing, pixels
    far: Range = (4.0, 12.0)  # largest depth that the network predicts, in medians of the depth
    # share of the pixels that float in front of their surface; eleven times as many at edges
    floaters: Range = (0.0, 0.004)
    turn: Range = (0.005, 0.3)  # rotation error of a pose, degrees
    shift: Range = (0.0001, 0.004)  # translation error of a pose, in median depths
    exposure: Range = (0.0, 0.12)  # deviation of the logarithm of a photo's brightness
    tint: Range = (0.0, 0.03)  # the same for each colour
    blur: Range = (0.3, 0.75)  # deviation of the lens's blur, pixels
    offset: Range = (0.0, 0.3)  # largest distance of a mean from its pixel's centre, pixels
    scale: Range = (0.5, 1.5)  # scale of a Gaussian across its normal, in footprints of its pixel
    scale_jitter: Range = (0.05, 0.35)  # deviation of the scales' logarithms
    flatness: Range = (0.15, 1.0)  # thickness along the normal, relative to the other axes
    tilt: Range = (0.02, 0.4)  # error of the normals, radians
    oversized: Range = (0.0, 0.006)  # share of the Gaussians that are far too large
    oversize: Range = (3.0, 12.0)  # largest factor of their size, at least 2
    trust: Range = (0.25, 1.0)  # confidence of pixels without errors
    constant_opacity: float = 0.2  # chance that all opacities are the same
    opacity_low: Range = (0.05, 0.4)  # opacity where the confidence is 0
    opacity_high: Range = (0.75, 0.99)  # opacity where the confidence is 1
    opacity_grain: Range = (0.0, 0.08)  # independent deviation of each opacity
    color_grain: Range = (0.0, 0.02)  # error of each colour
    color_blur: Range = (0.0, 0.6)  # deviation of the smoothing of colours, pixels; below 0.2: none
    sh_degrees: tuple[int, ...] = (0, 0, 0, 1, 2)  # degrees of the spherical harmonics, drawn with equal chances
    harmonics: Range = (0.0, 0.06)  # deviation of the higher coefficients
    unit: Range = (0.2, 5.0)  # world units per metre

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "constant_opacity":
                ok = 0 <= value <= 1
            elif f.name == "sh_degrees":
                ok = len(value) > 0 and all(degree in (0, 1, 2, 3) for degree in value)
            else:
                ok = len(value) == 2 and 0 <= value[0] <= value[1] < float("inf")
                ok = ok and (value[0] > 0 or f.name not in POSITIVE)
            if not ok:
                raise ValueError(f"{f.name}: expected a range of possible values, got {value!r}")


def read_ranges(path: Path) -> NoiseOptions:
    """Ranges from a TOML or JSON file: a table with some of the names, and two numbers for each.

    A SceneError if the file cannot be read, or holds an unknown name or an impossible range.
    """
    table = read_table(path)
    unknown = sorted(table.keys() - {f.name for f in fields(NoiseOptions)})
    if unknown:
        raise SceneError(path, f"unknown range {unknown[0]!r}", "docs/internals/generator.md has the names")
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in table.items()}
    try:
        return NoiseOptions(**values)
    except (ValueError, TypeError) as error:
        raise SceneError(path, str(error), "docs/internals/generator.md has the ranges") from error


@dataclass(frozen=True)
class Noise:
    """The values that one scene drew from :class:`NoiseOptions`, under the same names."""

    view_bias: float
    drift: float
    patches: float
    patch_error: float
    grain: float
    blank: float
    bleed: float
    bleed_width: float
    far: float
    floaters: float
    turn: float
    shift: float
    exposure: float
    tint: float
    blur: float
    offset: float
    scale: float
    scale_jitter: float
    flatness: float
    tilt: float
    oversized: float
    oversize: float
    trust: float
    opacity_low: float
    opacity_high: float
    opacity_grain: float
    color_grain: float
    color_blur: float
    sh_degree: int
    harmonics: float
    unit: float


def draw_noise(options: NoiseOptions, rng: np.random.Generator, factor: float = 1.0) -> Noise:
    """Values for one scene, with all errors times ``factor``, but not habits; shares and ``bleed`` are limited to 1."""
    drawn: dict[str, float] = {}
    for f in fields(Noise):
        if f.name == "sh_degree":
            continue
        bounds = getattr(options, f.name)
        drawn[f.name] = float(np.exp(rng.uniform(*np.log(bounds))) if f.name in SPREAD else rng.uniform(*bounds))
    for name in ERRORS:
        drawn[name] *= factor
    for name in ("bleed", "patches", "floaters", "oversized"):
        drawn[name] = min(drawn[name], 1.0)
    degree = int(options.sh_degrees[rng.integers(len(options.sh_degrees))])
    if rng.random() < options.constant_opacity:
        drawn["opacity_low"], drawn["opacity_grain"] = drawn["opacity_high"], 0.0
    return Noise(**drawn, sh_degree=degree)


@dataclass(frozen=True)
class GenerateOptions:
    """Settings of synthetic scenes; a ValueError if one is out of range."""

    views: tuple[int, int] = (6, 6)  # range of their number in a scene; one target is between any two neighbours
    width: int = 320  # of the views, pixels: 16 to 2048
    height: int = 240  # the same
    photo_scale: int = 1  # times the views' size that the photos have, 1 to 8; the network sees the views' own
    style: str = MIXED  # one of STYLES, or "mixed": each in turn
    path: str = MIXED  # one of PATHS, or "mixed": any
    noise: float = 1.0  # factor on the errors: 0 to 10
    ranges: NoiseOptions = field(default_factory=NoiseOptions)  # the errors and habits

    def __post_init__(self) -> None:
        low, high = self.views
        if not 2 <= low <= high <= 200:
            raise ValueError(f"views: expected 2 to 200, got {low} to {high}")
        for name in ("width", "height"):
            if not 16 <= getattr(self, name) <= 2048:
                raise ValueError(f"{name}: expected 16 to 2048 pixels, got {getattr(self, name)}")
        if not 1 <= self.photo_scale <= 8:
            raise ValueError(f"photo_scale: expected 1 to 8, got {self.photo_scale}")
        for name, known in (("style", STYLES), ("path", PATHS)):
            if getattr(self, name) not in (MIXED, *known):
                raise ValueError(f"{name}: expected {', '.join((MIXED, *known))}, got {getattr(self, name)!r}")
        if not 0 <= self.noise <= 10:
            raise ValueError(f"noise: expected 0 to 10, got {self.noise:g}")

    def to_dict(self) -> dict[str, Any]:
        """All settings as JSON types."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        if self.photo_scale == 1:  # as in records from before there was the setting
            del plain["photo_scale"]
        return plain
