"""Define the sizes of the networks, the bounds of their corrections, and the names and shapes of their weights."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from gsmerge.frozen import dataclass, fields
from gsmerge.method.networks.cross_view_stats import NUM_STATS
from gsmerge.settings.setting import Settings, setting

SLOTS = (1, 2, 4)  # there is a decoder head for each of these numbers of children
OUTPUTS = ("residual", "absolute")
STARTS = ("pooled", "first")
GEOMETRIES = ("analytic", "carried")
PART_COLUMNS = 13  # columns that describe a Gaussian in its group: position, log scales, opacity, colour, normal
MEMBER_COLUMNS = PART_COLUMNS + 6  # a member also has columns of its position in footprints, and of its colour
GROUP_COLUMNS = 19 + NUM_STATS  # numbers that describe a whole group
RESIDUAL = 13  # columns of a correction, see gsmerge.method.networks.corrections
FEATURE = RESIDUAL + 1  # columns of a correction of a Feature Gaussian; the last one changes its mass
CORRECTED = ("means", "covars", "masses", "extinctions", "sh0", "latents")  # fields that corrections change
PAPER_NUMBERS = (4, 8, 9, 10)  # mass and base colour, which are the numbers of a group that the paper's decoder reads


@dataclass(frozen=True)
class Bounds(Settings):
    """Largest corrections by the decoder.

    The encoder, the merger and the refiner may each correct by half as much as the decoder.
    """

    mean: float = setting(1.0, "Shift along each axis of the group's frame, in units of the Gaussian's size.", least=0,
        most=8)  # fmt: skip
    size: float = setting(1.1, "Change of each log scale.", least=0, most=8)
    turn: float = setting(0.5, "Rotation about each axis of the group's frame, radians.", least=0, most=8)
    logit: float = setting(3.0, "Change of the opacity's logit; of Feature Gaussians, of the logarithms of optical "
        "depth and of mass.", least=0, most=8)  # fmt: skip
    color: float = setting(0.25, "Change of each channel of the base colour, sRGB in [0, 1].", least=0, most=8)


ABSOLUTE_BOUNDS = Bounds(mean=4.0, size=6.0, turn=3.2, logit=8.0, color=0.75)  # for heads with absolute outputs


@dataclass(frozen=True)
class NetworkOptions(Settings):
    """Sizes and variants of the networks."""

    width: int = setting(48, "Width of the tokens, a multiple of `heads`.", least=1, most=512)
    heads: int = setting(4, "Attention heads.", least=1, most=16)
    blocks: int = setting(1, "Set attention blocks of the encoder and of the merger.", least=1, most=8)
    refine_blocks: int = setting(2, "Attention blocks of the refiner.", least=1, most=8)
    latent: int = setting(32, "Width of a Feature Gaussian's latent.", least=1, most=256)
    members: int = setting(16, "Largest number of members that the encoder reads; larger groups are sampled.", least=1,
        most=256)  # fmt: skip
    neighbors: int = setting(8, "Neighbours that the refiner reads.", least=1, most=64)
    bounds: Bounds = setting(Bounds(), "Largest corrections.")
    outputs: str = setting("residual", "`residual`: the heads correct the analytic children.",
        "`absolute`, as in the paper: they do not read these, and correct a round Gaussian with the group's mean and "
        "base colour, within wide bounds.", choices=OUTPUTS)  # fmt: skip
    encoder: bool = setting(True, "Use the encoder; without it all latents are zero.")
    merger: bool = setting(True, "Use the merger; without it clusters are only pooled.")
    merger_start: str = setting("pooled", "Input that the merger corrects: `pooled`: the moments of the whole cluster.",
        "`first`, as in the paper: the first Feature Gaussian of the cluster.", choices=STARTS)  # fmt: skip
    geometry: str = setting("analytic", "Source of the scales and rotations of Feature Gaussians.",
        "`analytic`: the moments. `carried`: the K = 1 head from the encoder on, as in the paper.",
        choices=GEOMETRIES)  # fmt: skip
    refiner: bool = setting(True, "Use the refiner.")
    group_numbers: bool = setting(True, "Give the heads all numbers that describe a group, which the paper does not.",
        "Otherwise a head reads latent, base colour and mass, as in the paper.")  # fmt: skip

    @property
    def head_numbers(self) -> tuple[int, ...]:
        """Indices of the group numbers that the heads read."""
        return tuple(range(GROUP_COLUMNS)) if self.group_numbers else PAPER_NUMBERS

    @property
    def reads_children(self) -> bool:
        """True if heads read the Gaussians that they correct.

        With absolute outputs there are no Gaussians to correct, and heads read only the size of the group.
        """
        return self.group_numbers or not self.makes_children

    @property
    def makes_children(self) -> bool:
        """True if heads make all children themselves, so that every group has exactly K of them."""
        return self.outputs == "absolute"

    @property
    def max_children(self) -> int:
        """Largest number of children that heads correct.

        Five or more children are corrected in two halves, which absolute heads cannot do.
        """
        return SLOTS[-1] if self.makes_children else 2 * SLOTS[-1]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % self.heads:
            raise ValueError(f"width: expected a multiple of {self.heads} heads, got {self.width}")

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> NetworkOptions:
        """Make options from the result of ``dataclasses.asdict``, or raise ValueError for a wrong name or value."""
        unknown = sorted(values.keys() - {f.name for f in fields(NetworkOptions)})
        bounds = values.get("bounds", {})
        if not isinstance(bounds, Mapping):
            raise ValueError(f"bounds: expected a table, got {bounds!r}")
        unknown += sorted(bounds.keys() - {f.name for f in fields(Bounds)})
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}")
        return NetworkOptions(**{**values, "bounds": Bounds(**bounds)})


def weight_shapes(options: NetworkOptions) -> dict[str, tuple[int, ...]]:
    """Return the shape of each weight of the networks by its name."""
    width = options.width
    latent = options.latent
    shapes = dict[str, tuple[int, ...]]()
    if options.encoder:
        shapes |= _set_network("encoder.set", MEMBER_COLUMNS, options)
        shapes |= {**_linear("encoder.latent", width, latent), **_linear("encoder.shift", width, 3)}
    if options.merger:
        shapes |= _set_network("merger.set", PART_COLUMNS + latent, options)
        shapes |= _linear("merger.out", width, FEATURE + latent)
    if options.refiner:
        shapes |= _mlp("refiner.embed", PART_COLUMNS + 1 + latent, width, width)
        for i in range(options.refine_blocks):
            shapes |= _block(f"refiner.blocks.{i}", width)
        shapes |= {**_norm("refiner.norm", width), **_mlp("refiner.join", width + GROUP_COLUMNS, 2 * width, width)}
        shapes |= _linear("refiner.out", width, FEATURE + latent)
    for slots in SLOTS:
        head = f"heads.{slots}"
        shapes |= _mlp(f"{head}.seeds", latent + len(options.head_numbers), width, slots * width)
        if options.reads_children:
            shapes |= _linear(f"{head}.child", PART_COLUMNS, width)
        shapes |= {**_block(f"{head}.block", width), **_norm(f"{head}.norm", width)}
        shapes |= _linear(f"{head}.out", width, RESIDUAL)
    return shapes


def _set_network(name: str, token: int, options: NetworkOptions) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of a network that reads a set of tokens, the encoder or the merger."""
    width = options.width
    shapes = _mlp(f"{name}.embed", token, width, width)
    for i in range(options.blocks):
        shapes |= _block(f"{name}.blocks.{i}", width)
    shapes |= {f"{name}.pool.seed": (1, 1, width), **_block(f"{name}.pool", width)}
    return shapes | _mlp(f"{name}.join", width + GROUP_COLUMNS, 2 * width, width)


def _block(name: str, width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of an attention block: attention, MLP and their norms."""
    attention = f"{name}.attention"
    return {
        **_norm(f"{name}.before", width),
        **_norm(f"{name}.between", width),
        **_linear(f"{attention}.query", width, width),
        **_linear(f"{attention}.pair", width, 2 * width),
        **_linear(f"{attention}.out", width, width),
        **_mlp(f"{name}.mlp", width, 2 * width, width),
    }


def _mlp(name: str, *widths: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of linear layers, which have even numbers, since activations have odd ones."""
    layers = (_linear(f"{name}.{2 * i}", *pair) for i, pair in enumerate(pairwise(widths)))
    return {key: shape for layer in layers for key, shape in layer.items()}


def _linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of a linear layer."""
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights of a layer norm."""
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}
