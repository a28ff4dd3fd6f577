"""Declare the settings of the stages before and after the fit, in their order."""

from __future__ import annotations

import math
import re
from typing import Literal

from gsmerge.frozen import dataclass
from gsmerge.settings.budget import AUTO, parse_share
from gsmerge.settings.setting import Settings, setting, suggest_name

Poses = Literal["auto", "fixed", "free"]
Exposure = Literal["auto", "fixed", "per-photo"]
Look = Literal["auto", "scene", "photos"]
Extent = Literal["auto", "photos", "beyond"]
MatchMethod = Literal["overlap", "aabb", "none"]
KRule = Literal["saliency", "distortion"]

SEGMENTATIONS = ("rdseg", "bass", "bass-st", "slic", "grid")
SHARE = "4.4%"  # default number of superpixels per pixel
MAX_CHILDREN = 8  # most Gaussians that a superpixel may become
# with this option, K is one of these numbers for each group
MIXED = "mixed"
MIXED_COUNTS = (1, 2, 4)
USUAL_K = 1  # the K of the option "auto", except for a single camera without a long fit
MATCH_NEIGHBORS = {"overlap": 16, "aabb": 1}  # default numbers to compare, see docs/internals/decisions.md#merging
CROP = "sphere:x,y,z,radius or box:x0,y0,z0,x1,y1,z1, optionally with three angles in degrees"
CROP_NUMBERS = {"sphere": (4,), "box": (6, 9)}
DROPS = ("floaters", "sky", "transparent", "unseen")


@dataclass(frozen=True)
class PrepareOptions(Settings):
    """Settings of the preparation: poses, exposure, colours and extent."""

    poses: Poses = setting("auto", "Move cameras to where their photos agree. auto: only if their poses are wrong; "
        "fixed: never; free: always.",
        "`auto` moves them if some view is more than 1.5 pixels off and agrees clearly better elsewhere. Cameras that "
        "move are refined during the fit.")  # fmt: skip
    exposure: Exposure = setting("auto", "Bring the exposure and white balance of all photos to their mean. "
        "auto: if they differ at random; fixed: never; per-photo: always.",
        "The Gaussians of their pixels change with them.")  # fmt: skip
    look: Look = setting("auto", "Source of the colours. photos: the photos; scene: the scene itself; auto: the "
        "photos, unless the scene was given another look, such as a style.")  # fmt: skip
    extent: Extent = setting("auto", "Places that may get Gaussians although the scene has none there. auto: small "
        "holes; photos: also large parts of the photos, such as the sky or what was cut out of the scene; beyond: also "
        "outside the photos, after a long fit.")  # fmt: skip


@dataclass(frozen=True)
class SegmentOptions(Settings):
    """Settings of cutting views into superpixels."""

    superpixels: int | str = setting(SHARE, "Superpixels per view: a number such as 3000, a share of its pixels, or "
        "auto. auto takes 4.4 to 7 %: the better the "
        "depths of the views agree, the more.")  # fmt: skip
    segmentation: str = setting("rdseg", "Method that cuts views into superpixels; "
        "`gsmerge.method.stages.superpixels` lists all.", choices=SEGMENTATIONS)  # fmt: skip
    rectangles: float | None = setting(None, "Of `rdseg`: number of rectangles per superpixel at its start.",
        "By default by effort: draft and fast 1, default 2, best 3.", least=1, unit="per superpixel")  # fmt: skip
    early_sweeps: int | None = setting(None, "Of `rdseg`: sweeps over border pixels before rectangles are merged.",
        "By default 0, with effort best 1.", least=0, most=1000)  # fmt: skip
    compactness: float = setting(1e-5, "Of `rdseg`: weight of squared distances in pixels, relative"
        " to squared differences of colours in [0, 1].",
        "At 0 superpixels become long and winding, and no Gaussian fits them.", least=0, most=1)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.per_view is not None and self.per_view < 1:
            raise ValueError(f"superpixels: expected at least 1, got {self.superpixels}")
        if self.per_view is None and self.superpixels != AUTO:
            try:
                parse_share(str(self.superpixels))
            except ValueError as error:
                raise ValueError(f"superpixels: expected a number, or {str(error).removeprefix('expected ')}") from None

    @property
    def per_view(self) -> int | None:
        """Number of superpixels of each view, if the setting is a number; None for a share or "auto"."""
        text = str(self.superpixels)
        return int(text) if text.removeprefix("-").isdecimal() else None

    @property
    def share(self) -> float:
        """Number of superpixels per pixel, if the setting is a share.

        If the setting is a number or "auto", this is the default share.
        """
        is_share = self.per_view is None and self.superpixels != AUTO
        return parse_share(str(self.superpixels) if is_share else SHARE)


@dataclass(frozen=True)
class MatchOptions(Settings):
    """Conditions under which Feature Gaussians of different views are merged."""

    match: MatchMethod | None = setting(None, "Rule by which Feature Gaussians of different views are merged.",
        "`overlap` compares Bhattacharyya coefficients and colours, and merges star clusters, which cannot chain. "
        "`aabb`, the rule of the paper (section 4.4), compares the IoU of boxes and latents, and merges connected "
        "components. By default `overlap`, but `none` in a draft.")  # fmt: skip
    overlap: float = setting(0.7, "Of `overlap`: least Bhattacharyya coefficient.", least=0, most=1)
    iou: float = setting(0.2, "Of `aabb`: least IoU of the boxes (tau_g).", least=0, most=1)
    similarity: float = setting(0.8, "Of `aabb`: least cosine of the latents (tau_f).",
        "Without latents, colours are compared.", least=-1,
        most=1)  # fmt: skip
    max_color: float = setting(0.12, "Largest difference of base colours (Euclidean, sRGB in [0, 1]).", least=0)
    neighbors: int | None = setting(None, "Number of nearest neighbours in 3D, of other views, to compare (k, which "
        "the paper does not give).",
        "By default 16 with `overlap` and 1 with `aabb`, where more would cause holes.",
        least=1, most=1000)  # fmt: skip
    cluster_size: int | None = setting(None, "Largest number of Feature Gaussians in a star cluster.",
        "By default the number of views.", least=1, most=1_000_000)  # fmt: skip

    @property
    def num_neighbors(self) -> int:
        """Number of nearest neighbours in other views with which each Feature Gaussian is compared."""
        return self.neighbors or MATCH_NEIGHBORS["aabb" if self.match == "aabb" else "overlap"]


@dataclass(frozen=True)
class DecodeOptions(Settings):
    """Settings of decoding, where each Feature Gaussian becomes one Gaussian or several."""

    k: int | Literal["mixed", "auto"] = setting(AUTO, "Gaussians per superpixel; more give more detail and a larger "
        "file. mixed: 1, 2 or 4, most where there is most to see; auto: 1, but 4 for a single camera without a long "
        "fit.",
        "`mixed` is described in the paper's supplement.", least=1, most=MAX_CHILDREN)  # fmt: skip
    k_low: float = setting(50.0, "Of `mixed`: percentile up to which groups become one Gaussian.",
        "The paper uses 33.3, and 66.7 for `k_high`.", least=0, most=100)  # fmt: skip
    k_high: float = setting(85.0, "Of `mixed`: percentile above which groups become four Gaussians.", least=0, most=100)
    k_rule: KRule = setting("saliency", "Of `mixed`: quantity that ranks the groups. `saliency`: the mean corner "
        "response of the group's pixels, as in the paper; `distortion`: the same number of Gaussians, where they "
        "lower distortion most.")  # fmt: skip
    min_opacity: float = setting(1 / 255, "Least opacity; Gaussians below it are left out (paper section 4.3, tau_a).",
        least=0, most=1)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.k_high < self.k_low:
            raise ValueError(f"k_high: expected at least k_low ({self.k_low:g}) and at most 100, got {self.k_high}")

    @property
    def mean_k(self) -> float:
        """Mean number of Gaussians per superpixel or group of superpixels."""
        mixed = 1 + (100 - self.k_low + 2 * (100 - self.k_high)) / 100
        return mixed if self.k == MIXED else float(self.max_k)

    @property
    def max_k(self) -> int:
        """Largest number of Gaussians per superpixel or group of superpixels."""
        return {MIXED: MIXED_COUNTS[-1], AUTO: USUAL_K}.get(str(self.k)) or int(self.k)


@dataclass(frozen=True)
class CleanOptions(Settings):
    """Settings of clean-up: Gaussians to leave out of the result."""

    crop: str | None = setting(None, "Keep only the Gaussians inside sphere:x,y,z,radius or box:x0,y0,z0,x1,y1,z1, in "
        "the scene's world units. The number of Gaussians, the fit and the scores refer to these.",
        "Three more numbers of a box turn it about its centre, in degrees about x, y and z.")  # fmt: skip
    drop: str | None = setting(None, "Kinds of Gaussians to leave out, separated by commas: floaters, sky, "
        "transparent, unseen.",
        "`floaters`: isolated, far beyond the scene, or huge and across it; `sky`: what is sky in the photos; "
        "`transparent`: opacity below 1/255; `unseen`: what no camera sees. Without cameras, viewpoints are "
        "placed.")  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.crop is not None:
            parse_crop(self.crop)
        for number, name in enumerate(self.drops):
            if name in self.drops[:number]:
                raise ValueError(f"drop: expected {name} once, got {self.drop!r}")
            if name not in DROPS:
                hint = suggest_name(name, DROPS)
                raise ValueError(f"drop: expected some of {', '.join(DROPS)}, separated by commas, got {name!r}{hint}")

    @property
    def drops(self) -> tuple[str, ...]:
        """Names of the kinds of Gaussians to leave out."""
        return () if self.drop is None else tuple(name.strip() for name in self.drop.split(","))

    @property
    def asked(self) -> bool:
        """True if the options ask for any clean-up."""
        return self.crop is not None or bool(self.drops)

    @property
    def visible_drops(self) -> list[str]:
        """Names of the settings in use that leave out something that photos show, such as the sky."""
        return ["drop sky"] if "sky" in self.drops else []


def parse_crop(text: str) -> tuple[str, tuple[float, ...]]:
    """Parse a crop into its shape, "sphere" or "box", and its numbers.

    Example:
        >>> parse_crop("sphere:0,0,2,1.5")
        ('sphere', (0.0, 0.0, 2.0, 1.5))
    """
    match = re.fullmatch(r"\s*(sphere|box)\s*:(.*)", str(text))
    try:
        numbers = tuple(float(part) for part in match[2].split(",")) if match else ()
    except ValueError:
        numbers = ()
    if match is None or len(numbers) not in CROP_NUMBERS[match[1]] or not all(map(math.isfinite, numbers)):
        raise ValueError(f"crop: expected {CROP}, got {text!r}")
    is_sphere = match[1] == "sphere"
    if numbers[3] <= 0 if is_sphere else any(high <= low for low, high in zip(numbers[:3], numbers[3:6], strict=False)):
        expected = "a radius above 0" if is_sphere else "x0 < x1, y0 < y1 and z0 < z1"
        raise ValueError(f"crop: expected {expected}, got {text!r}")
    return match[1], numbers


@dataclass(frozen=True)
class Engine(Settings):
    """Settings that say on which machines scenes or blocks are compacted.

    The result does not depend on these settings.
    """

    engine: str = setting("local", "Where scenes or blocks are compacted. local: on this machine; ray: on a Ray "
        "cluster, which needs the package `ray`.", choices=("local", "ray"))  # fmt: skip
    address: str | None = setting(None, "Address of the Ray cluster, such as auto or HOST:PORT.")  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is not None and self.engine != "ray":
            raise ValueError(f"address: expected engine ray, got {self.engine}")


@dataclass(frozen=True)
class BlockOptions(Settings):
    """Settings for compacting scenes with many views in blocks."""

    blocks: int | Literal["auto", "none"] = setting("auto", "Number of blocks of views that are compacted one by one. "
        "auto: one for every 8 million Gaussians if there are more than 20 million; also several for hundreds of "
        "views that see little of each other. none: one piece.",
        "A run needs the memory of one block. `auto` counts one Gaussian for each pixel.", least=1)  # fmt: skip
    engine: Engine = setting(Engine(), "Where the blocks are compacted.", internal=True)

    @property
    def asked(self) -> list[str]:
        """Name and value of the setting for messages, if it is a number of blocks; otherwise empty."""
        return [f"blocks {self.blocks}"] if isinstance(self.blocks, int) else []
