"""Settings of synthetic scenes, and the values that one scene draws from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.tables import read_table
from gsmerge.research.generate.paths import PATHS
from gsmerge.research.generate.styles import STYLES

Range = tuple[float, float]
MIXED = "mixed"
ERRORS = (
    *("view_bias", "drift", "patches", "patch_error", "grain", "bleed", "floaters", "turn", "shift"),
    *("exposure", "tint", "oversized", "tilt"),
)  # ranges that --noise scales; the others are habits of the exporter
SPREAD = ("view_bias", "drift", "grain", "turn", "shift")  # drawn uniformly in their logarithm


@dataclass(frozen=True)
class NoiseOptions:
    """Ranges of every error and habit of an exporter, from which each scene draws its values.

    Depth errors are deviations of the logarithm of depth, so about parts of the depth. docs/internals/generator.md
    compares them with real exports.

    Args:
        view_bias: Scale error of a view.
        drift: Slow error across a view.
        patches: Share of a view whose depth is wrong.
        patch_error: Error of these patches.
        grain: Independent error of each pixel.
        blank: Factor of additional errors where the photo has no texture.
        bleed: Blend towards a smoothed inverse depth at edges, 0 to 1.
        bleed_width: Deviation of that smoothing, pixels.
        far: Largest depth that the network predicts, in medians of the depth.
        floaters: Share of the pixels that float in front of their surface; eleven times as many at edges.
        turn: Rotation error of a pose, degrees.
        shift: Translation error of a pose, in median depths.
        exposure: Deviation of the logarithm of a photo's brightness.
        tint: The same for each colour.
        blur: Deviation of the lens's blur, pixels.
        offset: Largest distance of a mean from its pixel's centre, pixels.
        scale: Scale of a Gaussian across its normal, in footprints of its pixel.
        scale_jitter: Deviation of the scales' logarithms.
        flatness: Thickness along the normal, relative to the other axes.
        tilt: Error of the normals, radians.
        oversized: Share of the Gaussians that are far too large.
        oversize: Largest factor of their size, at least 2.
        trust: Confidence of pixels without errors.
        constant_opacity: Chance that all opacities are the same.
        opacity_low: Opacity where the confidence is 0.
        opacity_high: Opacity where the confidence is 1.
        opacity_grain: Independent deviation of each opacity.
        color_grain: Error of each colour.
        color_blur: Deviation of the smoothing of colours, pixels; below 0.2: none.
        sh_degrees: Degrees of the spherical harmonics, drawn with equal chances.
        harmonics: Deviation of the higher coefficients.
        unit: World units per metre.

    Raises:
        ValueError: If a range is empty or impossible.
    """

    view_bias: Range = (0.0002, 0.02)
    drift: Range = (0.0003, 0.02)
    patches: Range = (0.0, 0.3)
    patch_error: Range = (0.02, 0.5)
    grain: Range = (0.0007, 0.003)
    blank: Range = (0.0, 3.0)
    bleed: Range = (0.1, 1.0)
    bleed_width: Range = (0.6, 1.8)
    far: Range = (4.0, 12.0)
    floaters: Range = (0.0, 0.004)
    turn: Range = (0.005, 0.3)
    shift: Range = (0.0001, 0.004)
    exposure: Range = (0.0, 0.12)
    tint: Range = (0.0, 0.03)
    blur: Range = (0.3, 0.75)
    offset: Range = (0.0, 0.3)
    scale: Range = (0.5, 1.5)
    scale_jitter: Range = (0.05, 0.35)
    flatness: Range = (0.15, 1.0)
    tilt: Range = (0.02, 0.4)
    oversized: Range = (0.0, 0.006)
    oversize: Range = (3.0, 12.0)
    trust: Range = (0.25, 1.0)
    constant_opacity: float = 0.2
    opacity_low: Range = (0.05, 0.4)
    opacity_high: Range = (0.75, 0.99)
    opacity_grain: Range = (0.0, 0.08)
    color_grain: Range = (0.0, 0.02)
    color_blur: Range = (0.0, 0.6)
    sh_degrees: tuple[int, ...] = (0, 0, 0, 1, 2)
    harmonics: Range = (0.0, 0.06)
    unit: Range = (0.2, 5.0)

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "constant_opacity":
                ok = 0 <= value <= 1
            elif f.name == "sh_degrees":
                ok = len(value) > 0 and all(degree in (0, 1, 2, 3) for degree in value)
            else:
                ok = len(value) == 2 and 0 <= value[0] <= value[1] < float("inf")
                ok = ok and not (
                    f.name in (*SPREAD, "unit", "far", "scale", "bleed_width", "flatness", "blur") and value[0] == 0
                )
            if not ok:
                raise ValueError(f"{f.name}: expected a range of what its docstring says, got {value!r}")


def read_ranges(path: Path) -> NoiseOptions:
    """Ranges from a TOML or JSON file: a table with some of the names, and two numbers for each.

    Raises:
        SceneError: If the file cannot be read, or holds an unknown name or an impossible range.
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
        low, high = getattr(options, f.name)
        drawn[f.name] = float(
            np.exp(rng.uniform(np.log(low), np.log(high))) if f.name in (*SPREAD, "unit") else rng.uniform(low, high)
        )
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
    """Settings of synthetic scenes.

    Args:
        views: Range of the number of views of a scene; there is one target between any two neighbours.
        width: Pixels.
        height: Pixels.
        style: One of :data:`gsmerge.research.generate.styles.STYLES`, or "mixed": each in turn.
        path: One of :data:`gsmerge.research.generate.paths.PATHS`, or "mixed": any.
        noise: Factor on the errors of :class:`NoiseOptions`.
        ranges: The errors and habits.

    Raises:
        ValueError: If a setting is out of range.
    """

    views: tuple[int, int] = (6, 6)
    width: int = 320
    height: int = 240
    style: str = MIXED
    path: str = MIXED
    noise: float = 1.0
    ranges: NoiseOptions = field(default_factory=NoiseOptions)

    def __post_init__(self) -> None:
        low, high = self.views
        if not 2 <= low <= high <= 200:
            raise ValueError(f"views: expected 2 to 200, got {low} to {high}")
        for name in ("width", "height"):
            if not 16 <= getattr(self, name) <= 2048:
                raise ValueError(f"{name}: expected 16 to 2048 pixels, got {getattr(self, name)}")
        for name, known in (("style", STYLES), ("path", PATHS)):
            if getattr(self, name) not in (MIXED, *known):
                raise ValueError(f"{name}: expected {', '.join((MIXED, *known))}, got {getattr(self, name)!r}")
        if not 0 <= self.noise <= 10:
            raise ValueError(f"noise: expected 0 to 10, got {self.noise:g}")

    def to_dict(self) -> dict[str, Any]:
        """All settings as JSON types."""
        return _lists(asdict(self))


def _lists(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: _lists(value) if isinstance(value, Mapping) else list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
    }
