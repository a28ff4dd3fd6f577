"""Encoder, decoder heads, merger and refiner as torch modules, for training (paper sections 4.2 to 4.5).

All networks take tokens. The stages compute results by closed formulas, and the networks return raw corrections of
these results (fig. architecture). The last layers start at zero, so untrained networks change nothing.

All networks are built from the blocks of the Set Transformer (Lee et al. 2019). Sets are padded to one size. ``mask``
is True for tokens of the set and False for padding, which gets no attention.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from gsmerge.arrays import Array, as_array, as_tensor
from gsmerge.method.networks.options import (
    FEATURE,
    GROUP_COLUMNS,
    MEMBER_COLUMNS,
    PART_COLUMNS,
    RESIDUAL,
    SLOTS,
    NetworkOptions,
)
from gsmerge.method.networks.weights import NetworkWeights


def mlp(*widths: int) -> nn.Sequential:
    """Stack linear layers with GELU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.GELU()]
    return nn.Sequential(*layers[:-1])


def zero_init(layer: nn.Linear) -> nn.Linear:
    """Set a last layer's weights and bias to zero, so that its network corrects nothing before training."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def small_init(layer: nn.Linear) -> nn.Linear:
    """Make a layer's initial weights small.

    With weights of 0, the children of a group would be equal, would get equal gradients, and would therefore stay
    equal.
    """
    with torch.no_grad():
        for values in layer.parameters():
            values.mul_(0.1)
    return layer


class Attention(nn.Module):
    """Multi-head attention from ``x [b,q,w]`` to ``context [b,n,w]`` with ``mask [b,n]``."""

    def __init__(self, width: int, heads: int) -> None:
        """Make the layers for tokens of ``width`` numbers."""
        super().__init__()
        self.heads = heads
        self.query, self.pair, self.out = nn.Linear(width, width), nn.Linear(width, 2 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, context: Tensor, mask: Tensor) -> Tensor:
        """Return the attended values ``[b,q,w]``; the class names the shapes."""
        key, value = self.pair(context).chunk(2, -1)
        split = [t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (self.query(x), key, value)]
        mixed = scaled_dot_product_attention(split[0], split[1], split[2], attn_mask=mask[:, None, None])
        return self.out(mixed.transpose(1, 2).flatten(2))


class AttentionBlock(nn.Module):
    """Attention and an MLP, both residual with normalised inputs (paper fig. architecture: SAB).

    If ``first_only``, the result is the first token alone, ``[b,1,w]``.
    """

    def __init__(self, width: int, heads: int, *, first_only: bool = False) -> None:
        """Make the layers for tokens of ``width`` numbers."""
        super().__init__()
        self.first_only = first_only
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.mlp = Attention(width, heads), mlp(width, 2 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return the tokens ``x [b,n,w]`` after attending to each other; ``mask [b,n]``."""
        context = self.before(x)
        if self.first_only:
            x = x[:, :1]
        x = x + self.attention(context[:, : x.shape[1]], context, mask)
        return x + self.mlp(self.between(x))


class Pooling(nn.Module):
    """Reduce a set to one token by attention from a learned query (paper fig. architecture: PMA)."""

    def __init__(self, width: int, heads: int) -> None:
        """Make the layers for tokens of ``width`` numbers, and the query."""
        super().__init__()
        self.seed = nn.Parameter(torch.randn(1, 1, width) / width**0.5)
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.mlp = Attention(width, heads), mlp(width, 2 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return one token ``[b,w]`` for each set ``x [b,n,w]`` with ``mask [b,n]``."""
        query = self.seed.expand(len(x), -1, -1)
        pooled = query + self.attention(query, self.before(x), mask)
        return (pooled + self.mlp(self.between(pooled)))[:, 0]


class SetNetwork(nn.Module):
    """Layers of the kind that both the encoder and the merger have.

    Tokens pass through an MLP, attention blocks and pooling. The result is joined with the group's numbers in an MLP.
    """

    def __init__(self, token_width: int, out: int, options: NetworkOptions) -> None:
        """Make the layers for tokens of ``token_width`` numbers, and a result of ``out`` numbers."""
        super().__init__()
        width = options.width
        heads = options.heads
        self.embed = mlp(token_width, width, width)
        self.blocks = nn.ModuleList(AttentionBlock(width, heads) for _ in range(options.blocks))
        self.pool, self.join = Pooling(width, heads), mlp(width + GROUP_COLUMNS, 2 * width, out)

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Compute ``[b,out]`` from ``tokens [b,n,token_width]``, ``mask [b,n]`` and ``group [b,GROUP_COLUMNS]``."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x, mask)
        return self.join(torch.cat([self.pool(x, mask), group], -1))


class Encoder(nn.Module):
    """Network from a group's members to the group's latent and a shift of its mean."""

    def __init__(self, options: NetworkOptions) -> None:
        """Make the layers. An untrained encoder shifts no mean."""
        super().__init__()
        self.set = SetNetwork(MEMBER_COLUMNS, options.width, options)
        self.latent, self.shift = nn.Linear(options.width, options.latent), zero_init(nn.Linear(options.width, 3))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
        """Return the raw latent ``[b,latent]`` and the raw shift ``[b,3]``; arguments as in :class:`SetNetwork`."""
        hidden = nn.functional.gelu(self.set(tokens, mask, group))
        return self.latent(hidden), self.shift(hidden)


class Head(nn.Module):
    """Network from a Feature Gaussian and its K analytic children to corrections of the children."""

    def __init__(self, slots: int, options: NetworkOptions) -> None:
        """Make the layers of the head for at most ``slots`` children of a Feature Gaussian."""
        super().__init__()
        self.slots, width = slots, options.width
        self.numbers = list(options.head_numbers)
        self.seeds = mlp(options.latent + len(self.numbers), width, slots * width)
        self.child = nn.Linear(PART_COLUMNS, width) if options.reads_children else None
        self.block, self.norm = AttentionBlock(width, options.heads), nn.LayerNorm(width)
        self.out = (small_init if options.makes_children else zero_init)(nn.Linear(width, RESIDUAL))

    def forward(self, latents: Tensor, group: Tensor, children: Tensor, mask: Tensor) -> Tensor:
        """Return raw corrections ``[b,slots,RESIDUAL]`` of ``children [b,slots,PART_COLUMNS]``; ``mask [b,slots]``."""
        seeds = self.seeds(torch.cat([latents, group[:, self.numbers]], -1)).unflatten(-1, (self.slots, -1))
        slots = seeds if self.child is None else seeds + self.child(children)
        return self.out(self.norm(self.block(slots, mask)))


class Merger(nn.Module):
    """Network from the Feature Gaussians of a cluster to corrections of the pooled Feature Gaussian and its latent."""

    def __init__(self, options: NetworkOptions) -> None:
        """Make the layers. An untrained merger corrects nothing."""
        super().__init__()
        self.set = SetNetwork(PART_COLUMNS + options.latent, options.width, options)
        self.out = zero_init(nn.Linear(options.width, FEATURE + options.latent))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Return raw corrections ``[b,FEATURE+latent]``."""
        return self.out(nn.functional.gelu(self.set(tokens, mask, group)))


class Refiner(nn.Module):
    """Network from a Feature Gaussian and its nearest neighbours to corrections of this Feature Gaussian."""

    def __init__(self, options: NetworkOptions) -> None:
        """Make the layers. The last block computes only the token of the Feature Gaussian itself."""
        super().__init__()
        width = options.width
        last = options.refine_blocks - 1
        self.embed = mlp(PART_COLUMNS + 1 + options.latent, width, width)
        self.blocks = nn.ModuleList(
            AttentionBlock(width, options.heads, first_only=i == last) for i in range(options.refine_blocks)
        )
        self.norm, self.join = nn.LayerNorm(width), mlp(width + GROUP_COLUMNS, 2 * width, width)
        self.out = zero_init(nn.Linear(width, FEATURE + options.latent))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Return raw corrections ``[b,FEATURE+latent]``; the first token is the Feature Gaussian itself."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x, mask)
        joined = self.join(torch.cat([self.norm(x[:, 0]), group], -1))
        return self.out(nn.functional.gelu(joined))


class Networks(nn.Module):
    """The torch modules of a checkpoint. A network that the options leave out is None."""

    def __init__(self, options: NetworkOptions | None = None) -> None:
        """Make the networks that the options ask for, with random weights."""
        super().__init__()
        self.options = chosen = options or NetworkOptions()
        self.encoder = Encoder(chosen) if chosen.encoder else None
        self.merger = Merger(chosen) if chosen.merger else None
        self.refiner = Refiner(chosen) if chosen.refiner else None
        self.heads = nn.ModuleDict({str(slots): Head(slots, chosen) for slots in SLOTS})

    in_parallel = False  # gradients are recorded, so tables of groups have to run one after another

    def run(self, name: str, *inputs: Array) -> Tensor:
        """Run the module ``name`` like :meth:`NetworkWeights.run`, with gradients."""
        outputs = self.get_submodule(name)(*map(as_tensor, inputs))
        raw = torch.cat(outputs, 1) if isinstance(outputs, tuple) else outputs
        return torch.tanh(raw.nan_to_num()).flatten(1)

    def weights(self) -> NetworkWeights:
        """Return the weights as arrays, ready for use without torch."""
        arrays = {name: np.ascontiguousarray(as_array(tensor)) for name, tensor in self.state_dict().items()}
        return NetworkWeights(self.options, arrays)
