"""Run the forward pass of the networks on arrays with the native library.

Up to rounding, results equal the results of the torch modules for training, in
:mod:`gsmerge.research.training.modules`. Every group is computed by itself, so the results for a group depend neither
on the other groups of a table nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from gsmerge.arrays import Array
from gsmerge.frozen import dataclass, replace
from gsmerge.method.kernels.networks.layers import (
    GELU,
    PLAIN,
    TANH,
    attend,
    dense,
    normalise,
    pack_weights,
    padded,
    scratch_size,
)
from gsmerge.method.networks.options import NetworkOptions

Layer = tuple[np.ndarray, np.ndarray, int]  # packed weights, packed bias, and the number of outputs


class RunnableNetworks(Protocol):
    """Networks that the stages can run: :class:`NetworkWeights` of a checkpoint, or torch modules in training."""

    @property
    def options(self) -> NetworkOptions:
        """Options of the networks."""

    @property
    def in_parallel(self) -> bool:
        """True if tables of groups may run in several threads."""

    def run(self, name: str, *inputs: Any) -> Array:
        """Run one of the networks on a table of groups, see :meth:`NetworkWeights.run`."""


@dataclass(frozen=True, eq=False)
class NetworkWeights:
    """The networks of a checkpoint: their options, and their float32 weights by name."""

    options: NetworkOptions
    arrays: Mapping[str, np.ndarray]

    in_parallel = True

    @property
    def num_parameters(self) -> int:
        """Number of weights."""
        return sum(array.size for array in self.arrays.values())

    def heads_alone(self) -> NetworkWeights:
        """Return a copy that runs only the decoder heads, because the other networks take ten times as long."""
        options = replace(self.options, encoder=False, merger=False, refiner=False)
        return NetworkWeights(
            options, {name: array for name, array in self.arrays.items() if name.startswith("heads.")}
        )

    def run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        """Run ``"encoder"``, ``"merger"``, ``"refiner"`` or ``"heads.K"`` on a table of b groups.

        The torch module of this name takes the same inputs. Returns the outputs of this network after tanh in one array
        ``[b,columns]``, with 0 in place of NaN. The outputs of a head have ``K * 13`` columns, 13 for each child.
        """
        if name.startswith("heads."):
            return self._run_head(name, *inputs)
        return self._run_refiner(*inputs) if name == "refiner" else self._run_set_network(name, *inputs)

    def _run_set_network(self, name: str, tokens: np.ndarray, mask: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Run the encoder or the merger: embed tokens, run attention, pool tokens, and add the numbers of the group."""
        set_name = f"{name}.set"
        x = self._mlp(f"{set_name}.embed", tokens)
        for i in range(self.options.blocks):
            x = self._block(f"{set_name}.blocks.{i}", x, mask)
        pooled = self._pool(f"{set_name}.pool", x, mask)
        hidden = self._mlp(f"{set_name}.join", np.concatenate([pooled, group], 1), GELU)
        outs = ("latent", "shift") if name == "encoder" else ("out",)
        return np.concatenate([self._dense(f"{name}.{out}", hidden, TANH) for out in outs], 1)

    def _run_refiner(self, tokens: np.ndarray, mask: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Run the refiner.

        The first token of each group describes the group itself, and its other tokens describe neighbours.
        """
        x = self._mlp("refiner.embed", tokens)
        last = self.options.refine_blocks - 1
        for i in range(last + 1):
            x = self._block(f"refiner.blocks.{i}", x, mask, first_token_only=i == last)
        first_token = self._norm("refiner.norm", x[:, 0])
        hidden = self._mlp("refiner.join", np.concatenate([first_token, group], 1), GELU)
        return self._dense("refiner.out", hidden, TANH)

    def _run_head(
        self, name: str, latents: np.ndarray, group: np.ndarray, children: np.ndarray, mask: np.ndarray
    ) -> np.ndarray:
        """Run a decoder head: make a token for each child, run attention, and return a correction of each child."""
        numbers = group[:, list(self.options.head_numbers)]
        x = self._mlp(f"{name}.seeds", np.concatenate([latents, numbers], 1))
        x = x.reshape(*children.shape[:2], self.options.width)
        if self.options.reads_children:
            x = self._dense(f"{name}.child", children, residual=x)
        x = self._norm(f"{name}.norm", self._block(f"{name}.block", x, mask))
        return self._dense(f"{name}.out", x, TANH).reshape(len(children), -1)

    def _block(self, name: str, x: np.ndarray, mask: np.ndarray, *, first_token_only: bool = False) -> np.ndarray:
        """Run an attention block on tokens ``x``, for the outputs of all tokens or only of the first token."""
        context = self._norm(f"{name}.before", x)
        x, query = (x[:, :1], context[:, :1]) if first_token_only else (x, context)
        x = self._attention(f"{name}.attention", query, context, mask, x)
        return self._mlp(f"{name}.mlp", self._norm(f"{name}.between", x), residual=x)

    def _pool(self, name: str, x: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Reduce each set of n tokens ``x [b,n,w]`` to one token, ``[b,w]``."""
        query = np.repeat(self.arrays[f"{name}.seed"], len(x), 0)
        pooled = self._attention(f"{name}.attention", query, self._norm(f"{name}.before", x), mask, query)
        return self._mlp(f"{name}.mlp", self._norm(f"{name}.between", pooled), residual=pooled)[:, 0]

    def _attention(
        self, name: str, query: np.ndarray, context: np.ndarray, mask: np.ndarray, residual: np.ndarray
    ) -> np.ndarray:
        """Let tokens ``query [b,q,w]`` attend to ``context [b,n,w]``, and add ``residual [b,q,w]`` to the outputs."""
        sets, queries, width = query.shape
        heads = self.options.heads
        query = self._dense(f"{name}.query", query)
        pairs = self._dense(f"{name}.pair", context)
        mixed = np.empty((sets, queries, heads * padded(width // heads)), np.float32)
        scratch = np.empty(scratch_size(context.shape[1], width), np.float32)
        attend(query, pairs, np.ascontiguousarray(mask).view(np.uint8), heads, scratch, mixed)
        return self._dense(f"{name}.out", mixed, residual=residual)

    def _mlp(self, name: str, x: np.ndarray, activation: int = PLAIN, residual: np.ndarray | None = None) -> np.ndarray:
        """Run two linear layers with GELU between them, and add ``residual`` if given."""
        return self._dense(f"{name}.2", self._dense(f"{name}.0", x, GELU), activation, residual)

    def _dense(
        self, name: str, x: np.ndarray, activation: int = PLAIN, residual: np.ndarray | None = None
    ) -> np.ndarray:
        """Run a linear layer on the last axis, and add ``residual`` if given."""
        weight, bias, outputs = self._layers[name]
        rows = np.ascontiguousarray(x, np.float32).reshape(-1, x.shape[-1])
        out = np.empty((len(rows), outputs), np.float32)
        added = None if residual is None else np.ascontiguousarray(residual).reshape(-1, outputs)
        dense(rows, weight, bias, added, activation, out)
        return out.reshape(*x.shape[:-1], outputs)

    def _norm(self, name: str, x: np.ndarray) -> np.ndarray:
        """Run a layer norm on the last axis."""
        rows = np.ascontiguousarray(x).reshape(-1, x.shape[-1])
        out = np.empty_like(rows)
        normalise(rows, self.arrays[f"{name}.weight"], self.arrays[f"{name}.bias"], out)
        return out.reshape(x.shape)

    @cached_property
    def _layers(self) -> dict[str, Layer]:
        """All linear layers by name, packed as the library takes them.

        Layers before and after attention are padded with zeros, so that the values of each head fill whole vectors.
        """
        width = self.options.width
        heads = self.options.heads
        size = width // heads
        padded_columns = np.arange(width) // size * padded(size) + np.arange(width) % size
        layers = dict[str, Layer]()
        for name in [name.removesuffix(".weight") for name, array in self.arrays.items() if array.ndim == 2]:
            weight = self.arrays[f"{name}.weight"]
            bias = self.arrays[f"{name}.bias"]
            if name.endswith("attention.pair"):  # outputs are keys, which are not padded, and values
                rows = np.concatenate([np.arange(width), width + padded_columns])
                num_rows = width + heads * padded(size)
                padded_weight = np.zeros((num_rows, width), np.float32)
                padded_bias = np.zeros(num_rows, np.float32)
                padded_weight[rows] = weight
                padded_bias[rows] = bias
                weight = padded_weight
                bias = padded_bias
            elif name.endswith("attention.out"):  # inputs are means of the values
                padded_weight = np.zeros((width, heads * padded(size)), np.float32)
                padded_weight[:, padded_columns] = weight
                weight = padded_weight
            layers[name] = *pack_weights(weight, bias), len(bias)
        return layers
