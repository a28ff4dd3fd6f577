"""Layers of the networks match NumPy in float64, and the modules of torch that training uses."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from network_fixtures import noisy
from sweeps import sweep

from gsmerge.method.kernels import elementary
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
from gsmerge.method.networks.checkpoint import IN_PACKAGE
from gsmerge.method.networks.options import (
    GROUP_COLUMNS,
    MEMBER_COLUMNS,
    PART_COLUMNS,
    SLOTS,
    NetworkOptions,
    weight_shapes,
)
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.runtime.threads import parallel_map, use_threads

SHAPES = [(0, 3, 2), (1, 1, 1), (1, 5, 3), (5, 16, 16), (7, 48, 48), (13, 19, 50), (6, 0, 4)]
ODD = np.array([0, -0.0, 1e-30, -1e-30, 0.625, 0.95, 4, -9, 30, 1e30, -1e30, np.inf, -np.inf, np.nan], np.float32)
OTHERS = [
    NetworkOptions(width=20, heads=5, latent=7, refine_blocks=3, members=20),
    NetworkOptions(width=40, heads=2, blocks=2, refine_blocks=1),
]


def training_helpers() -> Any:
    pytest.importorskip("torch", reason="torch is not installed")
    return importlib.import_module("training_runs")


def some(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def activate(values: np.ndarray, activation: int) -> np.ndarray:
    """Return a dense layer that changes nothing, and its activation."""
    out = np.empty((len(values), 1), np.float32)
    dense(
        values.reshape(-1, 1),
        *pack_weights(np.ones((1, 1), np.float32), np.zeros(1, np.float32)),
        None,
        activation,
        out,
    )
    return out[:, 0]


@pytest.mark.parametrize(("rows", "inputs", "outputs"), SHAPES)
def test_dense_layer_matches_numpy(
    rows: int, inputs: int, outputs: int, each_target: Callable[..., list[np.ndarray]]
) -> None:
    x, weight, bias = some(rows, inputs), some(outputs, inputs, seed=1), some(outputs, seed=2)
    residual = some(rows, outputs, seed=3)

    def run() -> list[np.ndarray]:
        outs = [np.empty((rows, outputs), np.float32) for _ in range(3)]
        dense(x, *pack_weights(weight, bias), None, PLAIN, outs[0])
        dense(x, *pack_weights(weight, bias), residual, PLAIN, outs[1])
        dense(x, *pack_weights(weight, bias), residual, TANH, outs[2])
        return outs

    plain, added, bounded = each_target(run)
    expected = x.astype(np.float64) @ weight.T.astype(np.float64) + bias
    np.testing.assert_allclose(plain, expected, atol=1e-5)
    np.testing.assert_allclose(added, expected + residual, atol=1e-5)
    np.testing.assert_allclose(bounded, np.tanh(expected + residual), atol=1e-5)


def test_activations_match_their_formulas(each_target: Callable[..., list[np.ndarray]]) -> None:
    values = np.concatenate([np.linspace(-9, 9, 20001), np.geomspace(1e-30, 1, 2001)]).astype(np.float32)
    gelu, tanh = each_target(lambda: [activate(values, GELU), activate(values, TANH)])
    exact = values.astype(np.float64)
    cumulative = (1 + np.vectorize(math.erf)(exact / math.sqrt(2))) / 2
    np.testing.assert_allclose(gelu, exact * cumulative, atol=6e-7, rtol=0)
    np.testing.assert_allclose(gelu[values >= 0], (exact * cumulative)[values >= 0], rtol=4e-7)
    np.testing.assert_allclose(tanh, np.tanh(exact), rtol=2 * 2.0**-23)


def test_activations_of_odd_numbers_match_their_formulas(each_target: Callable[..., list[np.ndarray]]) -> None:
    gelu, tanh = each_target(lambda: [activate(ODD, GELU), activate(ODD, TANH)])
    finite, expected = np.isfinite(ODD), np.array([x / 2 * math.erfc(-x / 2**0.5) for x in ODD.tolist()])
    np.testing.assert_allclose(gelu[finite], expected[finite], rtol=1e-6, atol=1e-6)
    assert np.isnan(gelu[-1])
    np.testing.assert_allclose(tanh, np.tanh(np.nan_to_num(ODD)), rtol=3e-7)  # NaN corrects nothing


@pytest.mark.parametrize(("rows", "width"), [(0, 4), (1, 1), (3, 16), (5, 20), (2, 48), (4, 33)])
def test_normalised_rows_match_numpy(rows: int, width: int, each_target: Callable[..., list[np.ndarray]]) -> None:
    x, gains, shifts = 5 + some(rows, width), some(width, seed=1), some(width, seed=2)

    def run() -> list[np.ndarray]:
        out = np.empty_like(x)
        normalise(x, gains, shifts, out)
        return [out]

    exact = x.astype(np.float64)
    centred = exact - exact.mean(1, keepdims=True)
    expected = centred / np.sqrt((centred**2).mean(1, keepdims=True) + 1e-5) * gains + shifts
    np.testing.assert_allclose(each_target(run)[0], expected, atol=2e-5)


def slow_attention(query: np.ndarray, keys: np.ndarray, values: np.ndarray, mask: np.ndarray, heads: int) -> np.ndarray:
    size, out = query.shape[-1] // heads, np.zeros(query.shape)
    for s, q, h in np.ndindex(*query.shape[:2], heads):
        part = slice(h * size, (h + 1) * size)
        scores = keys[s, :, part].astype(np.float64) @ query[s, q, part] / math.sqrt(size)
        shares = np.where(mask[s], elementary.exp(scores - scores[mask[s]].max()), 0)
        out[s, q, part] = shares @ values[s, :, part] / shares.sum()
    return out


@pytest.mark.parametrize("tokens", [1, 2, 9, 16, 17, 40])
@pytest.mark.parametrize(("width", "heads"), [(48, 4), (20, 5), (40, 2), (3, 1)])
def test_attention_matches_a_slow_twin(
    tokens: int, width: int, heads: int, each_target: Callable[..., list[np.ndarray]]
) -> None:
    sets, queries, size = 3, 2, width // heads
    query, keys, values = (some(sets, n, width, seed=seed) for seed, n in enumerate((queries, tokens, tokens)))
    mask = np.random.default_rng(0).random((sets, tokens)) < 0.6
    mask[:, 0] = True
    places = np.arange(width) // size * padded(size) + np.arange(width) % size
    wide = np.zeros((sets, tokens, heads * padded(size)), np.float32)
    wide[..., places] = values

    def run() -> list[np.ndarray]:
        out = np.empty((sets, queries, wide.shape[2]), np.float32)
        scratch = np.full(scratch_size(tokens, width), np.nan, np.float32)
        attend(query, np.concatenate([keys, wide], 2), mask.view(np.uint8), heads, scratch, out)
        return [out]

    actual = each_target(run)[0][..., places]
    np.testing.assert_allclose(actual, slow_attention(query, keys, values, mask, heads), atol=1e-5)


def test_sizes_that_do_not_go_together_are_refused() -> None:
    x, out = some(2, 3), np.empty((2, 40), np.float32)
    with pytest.raises(ValueError, match="dense"):
        dense(x, *pack_weights(some(16, 3), some(16)), None, PLAIN, out)
    with pytest.raises(ValueError, match="activation"):
        dense(x, *pack_weights(some(40, 3), some(40)), None, 3, out)
    query, pairs, mask = some(1, 1, 6), some(1, 2, 6 + 2 * 16), np.ones((1, 2), np.uint8)
    mixed, scratch = np.empty((1, 1, 32), np.float32), np.empty(scratch_size(2, 6), np.float32)
    attend(query, pairs, mask, 2, scratch, mixed)
    for wrong in (
        (query, pairs, mask, 4, scratch, mixed),
        (query, pairs[..., :-1].copy(), mask, 2, scratch, mixed),
        (query, pairs, mask, 2, scratch[:-1], mixed),
        (query, pairs, mask, 2, scratch, mixed[..., :-1].copy()),
        (query, pairs, mask, 0, scratch, mixed),
    ):
        with pytest.raises(ValueError, match="attend"):
            attend(*wrong)


def inputs_of(name: str, options: NetworkOptions, count: int) -> tuple[np.ndarray, ...]:
    """Return random inputs of a network: some tokens do not count."""
    kind, _, slots = name.partition(".")
    width, tokens = {
        "encoder": (MEMBER_COLUMNS, options.members), "merger": (PART_COLUMNS + options.latent, 5),
        "refiner": (PART_COLUMNS + 1 + options.latent, options.neighbors + 1), "heads": (PART_COLUMNS, int(slots or 1)),
    }[kind]  # fmt: skip
    mask = np.random.default_rng(1).random((count, tokens)) < 0.7
    mask[:, 0] = True
    table, group = some(count, tokens, width, seed=2), some(count, GROUP_COLUMNS, seed=3)
    return (some(count, options.latent), group, table, mask) if kind == "heads" else (table, mask, group)


def names_of(options: NetworkOptions) -> list[str]:
    return [
        *(name for name in ("encoder", "merger", "refiner") if getattr(options, name)),
        *(f"heads.{k}" for k in SLOTS),
    ]


@sweep("which", [*IN_PACKAGE, *range(len(OTHERS))])
def test_networks_match_the_modules_of_training(which: str | int, each_target: Callable[..., list[np.ndarray]]) -> None:
    """Of what ships and of random ones, to rounding."""
    modules_of = training_helpers().modules_of
    named = isinstance(which, str)
    weights = load_checkpoint(IN_PACKAGE[which]).networks if named else noisy(OTHERS[which])
    modules = modules_of(weights)
    for name in names_of(weights.options):
        inputs = inputs_of(name, weights.options, 20)
        (actual,) = each_target(lambda name=name, inputs=inputs: [weights.run(name, *inputs)])
        expected = modules.run(name, *inputs).detach().numpy()
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(actual, expected, atol=1e-5, rtol=0, err_msg=name)


def test_every_group_is_computed_alone() -> None:
    """Whatever shares its table, and on any number of threads."""
    weights = load_checkpoint(IN_PACKAGE["shipped"]).networks
    for name in names_of(weights.options):
        inputs = inputs_of(name, weights.options, 40)
        whole = weights.run(name, *inputs)
        cuts = [slice(first, first + 7) for first in range(0, 40, 7)]
        for threads in (1, 3):
            with use_threads(threads):
                parts = parallel_map(lambda cut, name=name, all=inputs: weights.run(name, *(x[cut] for x in all)), cuts)
            assert np.array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("options", [NetworkOptions(), *OTHERS, NetworkOptions(encoder=False, merger=False)])
def test_shapes_of_weights_match_the_modules_of_training(options: NetworkOptions) -> None:
    state = training_helpers().Networks(options).state_dict()
    assert weight_shapes(options) == {name: tuple(tensor.shape) for name, tensor in state.items()}
