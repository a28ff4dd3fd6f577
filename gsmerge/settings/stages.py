"""Settings of the stages before and after the fit, in their order."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

from gsmerge.settings.budget import AUTO, parse_share
from gsmerge.settings.setting import Settings, perhaps, setting

Poses = Literal["auto", "fixed", "free"]
Exposure = Literal["auto", "fixed", "per-photo"]
Unseen = Literal["drop", "keep"]
Look = Literal["auto", "scene", "photos"]
Extent = Literal["auto", "photos", "beyond"]
MatchMethod = Literal["overlap", "aabb", "none"]
KRule = Literal["saliency", "distortion"]

SEGMENTATIONS = ("rdseg", "bass", "bass-st", "bass-adaptive", "slic", "grid")
SHARE = "4.4%"  # superpixels per pixel by default
AUTO_SHARE = "auto"
MAX_CHILDREN = 8
MIXED, MIXED_COUNTS = "mixed", (1, 2, 4)  # the K of groups of their own, and its values
USUAL_K = 1  # what "auto" is unless there are reasons for more
NEIGHBORS = {"overlap": 16, "aabb": 1}  # Nearest neighbours that are compared; docs/internals/notebook.md has figures
CROP = "sphere:x,y,z,radius, box:x0,y0,z0,x1,y1,z1 or a box with the degrees by which it is turned"
CROP_FILES = (".json", ".toml")  # endings of files that hold a crop, which the command line reads
CROP_NUMBERS = {"sphere": (4,), "box": (6, 9)}
DROPS = ("floaters", "sky", "transparent", "unseen")


@dataclass(frozen=True)
class PrepareOptions(Settings):
    """Settings of the preparation: poses, exposure, unseen Gaussians, and what photos may change."""

    poses: Poses = setting("auto", "Whether cameras may move: where they are off, never, or always.",
        "`free`: views are moved to where their photos agree, and the fit moves the cameras on; `auto`: where some "
        "view is more than 1.5 pixels off and agrees clearly better elsewhere.", uncut=("free",),
        in_piece="fixed")  # fmt: skip
    exposure: Exposure = setting("auto", "Bring photos that differ in exposure or white balance to their mean: where "
        "they differ at random, never, or always.",
        "The Gaussians of their pixels change with them.", uncut=("per-photo",), in_piece="fixed")  # fmt: skip
    unseen: Unseen = setting("drop", "What becomes of Gaussians without a pixel that no view sees.",
        "`drop`: they are left out. `keep`: they are merged among their neighbours, at the rate of the "
        "others.")  # fmt: skip
    look: Look = setting("auto", "Whose colours count: auto: those of the photos, but its own of a scene with another "
        "look; scene: its own; photos: theirs as they are.")  # fmt: skip
    extent: Extent = setting("auto", "Where the result may show more than the scene: auto: nowhere; photos: in large "
        "parts of the photos where the scene shows nothing, as one that was cut out or has no sky; beyond: beside the "
        "photos, after a long fit.")  # fmt: skip


@dataclass(frozen=True)
class SegmentOptions(Settings):
    """Settings of cutting views into superpixels."""

    superpixels: int | str = setting(SHARE, "Superpixels per view: a number such as 3000, a share of its pixels, or "
        "auto: 4.4 to 7 %, the more the better the depths of the views agree.",
        "A share is where `bass-adaptive` starts from.", metavar="NUMBER|SHARE|auto", counts=True)  # fmt: skip
    segmentation: str = setting("rdseg", "How superpixels are cut; `gsmerge.stages.superpixels` describes the methods.",
        choices=SEGMENTATIONS)  # fmt: skip
    rectangles: float | None = setting(None, "Of `rdseg`: rectangles per superpixel that it begins with.",
        "By default 2, and by effort.", least=1, unit="per superpixel")  # fmt: skip
    early_sweeps: int | None = setting(None, "Of `rdseg`: sweeps over border pixels before rectangles are merged.",
        "By default 0, and by effort.", least=0, most=1000)  # fmt: skip
    compactness: float = setting(1e-5, "Of `rdseg` and the clean-up of `slic`: weight of squared pixels against "
        "squared colours in [0, 1].",
        "At 0 superpixels become snakes that no Gaussian fits.", least=0, most=1)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.per_view is not None and self.per_view < 1:
            raise ValueError(f"superpixels: expected at least 1, got {self.superpixels}")
        if self.per_view is None and self.superpixels != AUTO_SHARE:
            try:
                parse_share(str(self.superpixels))
            except ValueError as error:
                raise ValueError(f"superpixels: expected a number, or {str(error).partition(' ')[2]}") from None

    @property
    def per_view(self) -> int | None:
        """Number of superpixels of each view; None if the option is a share of its pixels."""
        text = str(self.superpixels)
        return int(text) if text.removeprefix("-").isdecimal() else None

    @property
    def share(self) -> float:
        """Superpixels per pixel; the default share where the option gives a number or "auto"."""
        is_share = self.per_view is None and self.superpixels != AUTO_SHARE
        return parse_share(str(self.superpixels) if is_share else SHARE)

    @property
    def adapts(self) -> bool:
        """Whether each view adapts its number of superpixels: ``bass-adaptive`` with a share of the pixels."""
        return self.segmentation == "bass-adaptive" and self.per_view is None


@dataclass(frozen=True)
class MatchOptions(Settings):
    """Conditions under which Feature Gaussians of different views are merged."""

    match: MatchMethod | None = setting(None, "How Feature Gaussians of different views are merged.",
        "`overlap`: Bhattacharyya coefficient, similar colours, star clusters that cannot chain. `aabb`, as in the "
        "paper (section 4.4): box IoU, similar latents, connected components. By default `overlap`, but `none` in a "
        "draft.", neutral=("none",))  # fmt: skip
    overlap: float = setting(0.7, "Least overlap of `overlap`.", least=0, most=1)
    iou: float = setting(0.2, "Least IoU of the boxes of `aabb` (tau_g).", least=0, most=1)
    similarity: float = setting(0.8, "Least cosine of the latents of `aabb` (tau_f).",
        "Without latents colours are compared.", least=-1,
        most=1)  # fmt: skip
    max_color: float = setting(0.12, "Largest difference of base colours (Euclidean, sRGB in [0, 1]).", least=0)
    neighbors: int | None = setting(None, "Nearest neighbours of other views in 3D that are compared (k, which the "
        "paper leaves open).",
        "By default 16 with `overlap`, 1 with `aabb`, which leaves holes with more.",
        least=1, most=1000)  # fmt: skip
    cluster_size: int | None = setting(None, "Most Feature Gaussians in a star cluster.",
        "By default as many as there are views.", least=1, most=1_000_000)  # fmt: skip

    @property
    def num_neighbors(self) -> int:
        """Number of nearest neighbours in other views that each Feature Gaussian is compared with."""
        return self.neighbors or NEIGHBORS["aabb" if self.match == "aabb" else "overlap"]


@dataclass(frozen=True)
class DecodeOptions(Settings):
    """Settings of decoding: how many Gaussians each Feature Gaussian becomes."""

    k: int | Literal["mixed", "auto"] = setting(AUTO, "More detail and a larger file: Gaussians for each superpixel; "
        "mixed: 1, 2 or 4, most where there is most to see; auto: 1, and 4 for one photo without a long fit.",
        "`mixed` is of the paper's supplement.", least=1, most=MAX_CHILDREN, metavar="1-8|mixed|auto",
        counts=True)  # fmt: skip
    k_low: float = setting(50.0, "Percentile of `mixed` up to which groups become one Gaussian.",
        "The paper's are 33.3 and 66.7.", least=0, most=100)  # fmt: skip
    k_high: float = setting(85.0, "Percentile of `mixed` above which groups become four Gaussians.", least=0, most=100)
    k_rule: KRule = setting("saliency", "What the percentiles are of: `saliency`, the mean corner response of the "
        "group's pixels, as in the paper, or `distortion`: as many Gaussians, where they lower distortion "
        "most.")  # fmt: skip
    min_opacity: float = setting(1 / 255, "Gaussians below this opacity are left out (paper section 4.3, tau_a).",
        least=0, most=1)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.k_high < self.k_low:
            raise ValueError(f"k_high: expected {self.k_low:g}, which is k_low, to 100, got {self.k_high}")

    @property
    def mean_k(self) -> float:
        """Mean number of Gaussians per group."""
        mixed = 1 + (100 - self.k_low + 2 * (100 - self.k_high)) / 100
        return mixed if self.k == MIXED else float(self.max_k)

    @property
    def max_k(self) -> int:
        """Largest number of Gaussians per group."""
        return {MIXED: MIXED_COUNTS[-1], AUTO: USUAL_K}.get(str(self.k)) or int(self.k)


@dataclass(frozen=True)
class CleanOptions(Settings):
    """Settings of clean-up: what to leave out of the result."""

    crop: str | None = setting(None, "Keep the Gaussians inside a sphere:x,y,z,radius or box:x0,y0,z0,x1,y1,z1, in the "
        "scene's world units, or inside the shape of a .json or .toml file; counts, fit and scores are of these.",
        "Three more numbers of a box turn it about its middle: degrees about x, y and z. The command line alone reads "
        "files.", metavar="SHAPE", common=True, whole="name", in_trial=None)  # fmt: skip
    drop: str | None = setting(None, "Leave out floaters, sky, transparent or unseen Gaussians, with commas between.",
        "`floaters`: isolated, far beyond the scene, or hanging across it; `sky`: what is sky in the photos; "
        "`transparent`: of an opacity below 1/255; `unseen`: what no camera shows, without cameras no placed one.",
        metavar="floaters,sky,...", common=True, whole="value", in_trial=None)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.crop is not None:
            parse_crop(self.crop)
        for number, name in enumerate(self.drops):
            if name in self.drops[:number]:
                raise ValueError(f"drop: expected {name} once, got {self.drop!r}")
            if name not in DROPS:
                near = perhaps(name, DROPS)
                raise ValueError(f"drop: expected some of {', '.join(DROPS)}, with commas between, got {name!r}{near}")

    @property
    def drops(self) -> tuple[str, ...]:
        """Names of the kinds of Gaussians to drop."""
        return () if self.drop is None else tuple(name.strip() for name in self.drop.split(","))

    @property
    def asked(self) -> bool:
        """Whether any clean-up is asked for."""
        return self.crop is not None or bool(self.drops)

    @property
    def hiding(self) -> list[str]:
        """Names of what is asked for that removes things which photos show."""
        return ["drop sky"] if "sky" in self.drops else []


def parse_crop(text: str) -> tuple[str, tuple[float, ...]]:
    """Parse a crop into its shape and numbers.

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
    """Place where the blocks of a scene are compacted; the result does not depend on it."""

    engine: str = setting("local", "Where scenes, or the blocks of one, are compacted. local: on this machine; ray: a "
        "Ray cluster, gsmerge[ray].", choices=("local", "ray"))  # fmt: skip
    address: str | None = setting(None, "Address of the Ray cluster, such as auto or HOST:PORT.",
        shown="one of this machine")  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is not None and self.engine != "ray":
            raise ValueError(f"address: expected engine ray, got {self.engine}")


@dataclass(frozen=True)
class BlockOptions(Settings):
    """Settings for compacting scenes with many views in blocks."""

    blocks: int | Literal["auto", "none"] = setting("auto", "Blocks of views that are compacted one by one, for scenes "
        "of hundreds of views; auto: beyond 20 million Gaussians, one for every 8 million, and for hundreds of views "
        "that see little of each other.",
        "Memory is that of one block. `auto` counts one Gaussian for each pixel; `none`: one piece.", least=1,
        metavar="auto|none|NUMBER", in_piece="none")  # fmt: skip
    engine: Engine = setting(Engine(), "Where the blocks are compacted.", internal=True)

    @property
    def asked(self) -> list[str]:
        """What messages call a number of blocks; empty without one."""
        return [f"blocks {self.blocks}"] if isinstance(self.blocks, int) else []
