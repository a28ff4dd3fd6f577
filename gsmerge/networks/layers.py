"""Blocks of the Set Transformer (Lee et al. 2019): attention within a set, and from a learned query to a set.

Sets are padded; ``mask`` is True where a token is one of the set's own. Padded tokens are never attended to.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers with GELU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.GELU()]
    return nn.Sequential(*layers[:-1])


def silent(layer: nn.Linear) -> nn.Linear:
    """The layer with weights and bias zero: what it corrects stays as it is until it is trained."""
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
        """``[b,q,w]``."""
        key, value = self.pair(context).chunk(2, -1)
        split = [t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (self.query(x), key, value)]
        found = scaled_dot_product_attention(split[0], split[1], split[2], attn_mask=mask[:, None, None])
        return self.out(found.transpose(1, 2).flatten(2))


class AttentionBlock(nn.Module):
    """Attention and an MLP, both with normalised inputs and as corrections (paper fig. architecture: SAB).

    ``first``: only the first token is worked out, ``[b,1,w]``.
    """

    def __init__(self, width: int, heads: int, *, first: bool = False) -> None:
        super().__init__()
        self.first = first
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.mlp = Attention(width, heads), mlp(width, 2 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """``[b,n,w]`` tokens that know of each other."""
        context = self.before(x)
        if self.first:
            x = x[:, :1]
        x = x + self.attention(context[:, : x.shape[1]], context, mask)
        return x + self.mlp(self.between(x))


class Pooling(nn.Module):
    """One token for a set, from a learned query (paper fig. architecture: PMA)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.seed = nn.Parameter(torch.randn(1, 1, width) / width**0.5)
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.mlp = Attention(width, heads), mlp(width, 2 * width, width)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """``[b,w]``."""
        query = self.seed.expand(len(x), -1, -1)
        pooled = query + self.attention(query, self.before(x), mask)
        return (pooled + self.mlp(self.between(pooled)))[:, 0]
