"""Encoder, decoder heads, merger and refiner (paper sections 4.2 to 4.5, fig. architecture).

All of them take tokens and give corrections: raw outputs that :mod:`gsmerge.networks.residuals` bounds and applies to
what the analytic stages made. The last layers start at zero, so untrained networks change nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gsmerge.networks.layers import AttentionBlock, Pooling, mlp, silent
from gsmerge.networks.options import NetworkOptions
from gsmerge.networks.residuals import RESIDUAL
from gsmerge.networks.tokens import GROUP, MEMBER, PART

SLOTS = (1, 2, 4)  # children that there is a decoder head for


class SetNetwork(nn.Module):
    """The pattern that encoder and merger share: MLP tokens, attention blocks, pooling, an MLP that sees the group."""

    def __init__(self, token: int, out: int, options: NetworkOptions) -> None:
        super().__init__()
        width, heads = options.width, options.heads
        self.embed = mlp(token, width, width)
        self.blocks = nn.ModuleList(AttentionBlock(width, heads) for _ in range(options.blocks))
        self.pool, self.join = Pooling(width, heads), mlp(width + GROUP, 2 * width, out)

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """``[b,out]`` of ``tokens [b,n,token]``, ``mask [b,n]`` and ``group [b,GROUP]``."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x, mask)
        return self.join(torch.cat([self.pool(x, mask), group], -1))


class Encoder(nn.Module):
    """Members of a group -> its latent and a shift of its mean."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.set = SetNetwork(MEMBER, options.width, options)
        self.latent, self.shift = nn.Linear(options.width, options.latent), silent(nn.Linear(options.width, 3))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
        """Raw latent ``[b,latent]`` and raw shift ``[b,3]``."""
        found = nn.functional.gelu(self.set(tokens, mask, group))
        return self.latent(found), self.shift(found)


class Head(nn.Module):
    """A Feature Gaussian and its K analytic children -> corrections of the children."""

    def __init__(self, slots: int, options: NetworkOptions) -> None:
        super().__init__()
        self.slots, width = slots, options.width
        self.seeds = mlp(options.latent + GROUP, width, slots * width)
        self.child = nn.Linear(PART, width)
        self.block, self.norm = AttentionBlock(width, options.heads), nn.LayerNorm(width)
        self.out = silent(nn.Linear(width, RESIDUAL))

    def forward(self, latents: Tensor, group: Tensor, children: Tensor, mask: Tensor) -> Tensor:
        """Raw corrections ``[b,slots,RESIDUAL]`` of ``children [b,slots,PART]`` with ``mask [b,slots]``."""
        seeds = self.seeds(torch.cat([latents, group], -1)).unflatten(-1, (self.slots, -1))
        return self.out(self.norm(self.block(seeds + self.child(children), mask)))


class Merger(nn.Module):
    """The Feature Gaussians of a cluster -> corrections of the pooled one and of its latent."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.set = SetNetwork(PART + options.latent, options.width, options)
        self.out = silent(nn.Linear(options.width, RESIDUAL + options.latent))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Raw corrections ``[b,RESIDUAL+latent]``."""
        return self.out(nn.functional.gelu(self.set(tokens, mask, group)))


class Refiner(nn.Module):
    """A Feature Gaussian and its nearest neighbours -> corrections of the Feature Gaussian and of its latent."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        width, last = options.width, options.refine_blocks - 1
        self.embed = mlp(PART + 1 + options.latent, width, width)
        self.blocks = nn.ModuleList(
            AttentionBlock(width, options.heads, first=i == last) for i in range(options.refine_blocks)
        )
        self.norm, self.join = nn.LayerNorm(width), mlp(width + GROUP, 2 * width, width)
        self.out = silent(nn.Linear(width, RESIDUAL + options.latent))

    def forward(self, tokens: Tensor, mask: Tensor, group: Tensor) -> Tensor:
        """Raw corrections ``[b,RESIDUAL+latent]``; the first token is the Feature Gaussian itself."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x, mask)
        joined = self.join(torch.cat([self.norm(x[:, 0]), group], -1))
        return self.out(nn.functional.gelu(joined))


class Networks(nn.Module):
    """All of them, for one checkpoint."""

    def __init__(self, options: NetworkOptions | None = None) -> None:
        super().__init__()
        self.options = options or NetworkOptions()
        self.encoder, self.merger, self.refiner = Encoder(self.options), Merger(self.options), Refiner(self.options)
        self.heads = nn.ModuleDict({str(slots): Head(slots, self.options) for slots in SLOTS})

    @property
    def num_parameters(self) -> int:
        """Numbers in the checkpoint."""
        return sum(p.numel() for p in self.parameters())
