"""Encoder, decoder heads, merger and refiner (paper sections 4.2 to 4.5, fig. architecture).

All of them take tokens and return raw corrections, which :mod:`gsmerge.networks.residuals` bounds and applies to the
results of the analytic stages. The last layers start at zero, so untrained networks change nothing.

They are built from the blocks of the Set Transformer (Lee et al. 2019). Sets are padded; ``mask`` is True where a token
is one of the set's own. Padded tokens are never attended to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from gsmerge.networks.residuals import RESIDUAL, WIDE, Bounds
from gsmerge.networks.tokens import GROUP, MEMBER, PART

SLOTS = (1, 2, 4)  # numbers of children that have a decoder head
OUTPUTS = ("residual", "absolute")


def mlp(*widths: int) -> nn.Sequential:
    """Stack linear layers with GELU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.GELU()]
    return nn.Sequential(*layers[:-1])


def zero_init(layer: nn.Linear) -> nn.Linear:
    """Set a layer's weights and bias to zero: until trained, it corrects nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class Attention(nn.Module):
    """Multi-head attention from ``x [b,q,w]`` to ``context [b,n,w]`` with ``mask [b,n]``."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.pair, self.out = nn.Linear(width, width), nn.Linear(width, 2 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, context: Tensor, mask: Tensor) -> Tensor:
        """Return the mixed values ``[b,q,w]``."""
        key, value = self.pair(context).chunk(2, -1)
        split = [t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (self.query(x), key, value)]
        mixed = scaled_dot_product_attention(split[0], split[1], split[2], attn_mask=mask[:, None, None])
        return self.out(mixed.transpose(1, 2).flatten(2))


class AttentionBlock(nn.Module):
    """Attention and an MLP, both residual with normalised inputs (paper fig. architecture: SAB).

    ``first``: computes only the first token, ``[b,1,w]``.
    """

    def __init__(self, width: int, heads: int, *, first: bool = False) -> None:
        super().__init__()
        self.first = first
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.mlp = Attention(width, heads), mlp(width, 2 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return the tokens ``[b,n,w]`` after attending to each other."""
        context = self.before(x)
        if self.first:
            x = x[:, :1]
        x = x + self.attention(context[:, : x.shape[1]], context, mask)
        return x + self.mlp(self.between(x))


class Pooling(nn.Module):
    """Reduction of a set to one token by a learned query (paper fig. architecture: PMA)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.seed = nn.Parameter(torch.randn(1, 1, width) / width**0.5)
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.mlp = Attention(width, heads), mlp(width, 2 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return one token for each set, ``[b,w]``."""
        query = self.seed.expand(len(x), -1, -1)
        pooled = query + self.attention(query, self.before(x), mask)
        return (pooled + self.mlp(self.between(pooled)))[:, 0]


class SetNetwork(nn.Module):
    """Part that encoder and merger share: MLP of tokens, attention blocks, pooling, MLP with the group's numbers."""

    def __init__(self, token: int, out: int, options: NetworkOptions) -> None:
        super().__init__()
        width, heads = options.width, options.heads
        self.embed = mlp(token, width, width)
        self.blocks = nn.ModuleList(AttentionBlock(width, heads) for _ in range(options.blocks))
        self.pool, self.join = Pooling(width, heads), mlp(width + GROUP, 2 * width, out)

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Compute ``[b,out]`` from ``tokens [b,n,token]``, ``mask [b,n]`` and ``group [b,GROUP]``."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x, mask)
        return self.join(torch.cat([self.pool(x, mask), group], -1))


class Encoder(nn.Module):
    """Network from the members of a group to its latent and a shift of its mean."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.set = SetNetwork(MEMBER, options.width, options)
        self.latent, self.shift = nn.Linear(options.width, options.latent), zero_init(nn.Linear(options.width, 3))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw latent ``[b,latent]`` and raw shift ``[b,3]``."""
        hidden = nn.functional.gelu(self.set(tokens, mask, group))
        return self.latent(hidden), self.shift(hidden)


class Head(nn.Module):
    """Network from a Feature Gaussian and its K analytic children to corrections of the children."""

    def __init__(self, slots: int, options: NetworkOptions) -> None:
        super().__init__()
        self.slots, width = slots, options.width
        self.seeds = mlp(options.latent + GROUP, width, slots * width)
        self.child = nn.Linear(PART, width)
        self.block, self.norm = AttentionBlock(width, options.heads), nn.LayerNorm(width)
        self.out = zero_init(nn.Linear(width, RESIDUAL))

    def forward(self, latents: Tensor, group: Tensor, children: Tensor, mask: Tensor) -> Tensor:
        """Return raw corrections ``[b,slots,RESIDUAL]`` of ``children [b,slots,PART]`` with ``mask [b,slots]``."""
        seeds = self.seeds(torch.cat([latents, group], -1)).unflatten(-1, (self.slots, -1))
        return self.out(self.norm(self.block(seeds + self.child(children), mask)))


class Merger(nn.Module):
    """Network from the Feature Gaussians of a cluster to corrections of the pooled one and of its latent."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.set = SetNetwork(PART + options.latent, options.width, options)
        self.out = zero_init(nn.Linear(options.width, RESIDUAL + options.latent))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Return raw corrections ``[b,RESIDUAL+latent]``."""
        return self.out(nn.functional.gelu(self.set(tokens, mask, group)))


class Refiner(nn.Module):
    """Network from a Feature Gaussian and its nearest neighbours to corrections of it and of its latent."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        width, last = options.width, options.refine_blocks - 1
        self.embed = mlp(PART + 1 + options.latent, width, width)
        self.blocks = nn.ModuleList(
            AttentionBlock(width, options.heads, first=i == last) for i in range(options.refine_blocks)
        )
        self.norm, self.join = nn.LayerNorm(width), mlp(width + GROUP, 2 * width, width)
        self.out = zero_init(nn.Linear(width, RESIDUAL + options.latent))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Return raw corrections ``[b,RESIDUAL+latent]``; the first token is the Feature Gaussian itself."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x, mask)
        joined = self.join(torch.cat([self.norm(x[:, 0]), group], -1))
        return self.out(nn.functional.gelu(joined))


class Networks(nn.Module):
    """The networks of a checkpoint, None for each that the options leave out."""

    def __init__(self, options: NetworkOptions | None = None) -> None:
        super().__init__()
        self.options = chosen = options or NetworkOptions()
        self.encoder = Encoder(chosen) if chosen.encoder else None
        self.merger = Merger(chosen) if chosen.merger else None
        self.refiner = Refiner(chosen) if chosen.refiner else None
        self.heads = nn.ModuleDict({str(slots): Head(slots, chosen) for slots in SLOTS})

    @property
    def max_children(self) -> int:
        """Largest number of children that the heads correct; five or more in two halves, not for absolute outputs."""
        return SLOTS[-1] if self.options.outputs == "absolute" else 2 * SLOTS[-1]

    @property
    def num_parameters(self) -> int:
        """Number of weights in the checkpoint."""
        return sum(p.numel() for p in self.parameters())


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
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= limit:
                raise ValueError(f"{name}: expected a whole number from 1 to {limit}, got {value!r}")
        for name in ("encoder", "merger", "refiner"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: expected true or false, got {getattr(self, name)!r}")
        if self.width % self.heads:
            raise ValueError(f"width: expected a multiple of {self.heads} heads, got {self.width}")

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> NetworkOptions:
        """Read options from what ``dataclasses.asdict`` gave; a ValueError if a name or a value is impossible."""
        unknown = sorted(values.keys() - {f.name for f in fields(NetworkOptions)})
        bounds = values.get("bounds", {})
        if not isinstance(bounds, Mapping):
            raise ValueError(f"bounds: expected a table, got {bounds!r}")
        unknown += sorted(bounds.keys() - {f.name for f in fields(Bounds)})
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}")
        return NetworkOptions(**{**values, "bounds": Bounds(**bounds)})
