"""The stages' geometry as tensors: values as the kernels', gradients as central differences of everything after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from network_fixtures import SMALL, Made, made
from scenes import arc, make_scene, room
from sweeps import sweep
from training_runs import PAPER, TINY, noisy_networks, torch, whole_photo

from gsmerge.arrays import as_array
from gsmerge.geometry.pooling import feature_to_gaussians
from gsmerge.networks import apply, tokens
from gsmerge.networks.apply import NetworkContext, encode_features
from gsmerge.networks.corrections import (
    COLOR_COLUMNS,
    LOGIT_COLUMN,
    MASS_COLUMN,
    MEAN_COLUMNS,
    ROTATION_COLUMNS,
    SIZE_COLUMNS,
)
from gsmerge.networks.options import FEATURE, NetworkOptions
from gsmerge.networks.tensors import quat_to_rotmat
from gsmerge.research.training import Example, make_example, make_training_scene
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.predict import (
    TrainingContext,
    differentiate_axes,
    features_to_arrays,
    features_to_tensors,
    pool_tensors,
    predict,
)
from gsmerge.research.training.windows import Crop
from gsmerge.stages.match import match
from gsmerge.stages.merge import cluster_runs, pool_runs
from gsmerge.types import FeatureGaussians, Matches

pytestmark = pytest.mark.usefixtures("one_thread")
COLUMNS = {
    "mean": MEAN_COLUMNS,
    "size": SIZE_COLUMNS,
    "turn": ROTATION_COLUMNS,
    "logit": slice(LOGIT_COLUMN, LOGIT_COLUMN + 1),
    "color": COLOR_COLUMNS,
}
SIZE_OF_ROOM = 0.1  # world units, of what a superpixel shows
OF_FEATURES = COLUMNS | {"mass": slice(MASS_COLUMN, MASS_COLUMN + 1), "latent": slice(FEATURE, FEATURE + TINY.latent)}


@pytest.fixture(scope="module")
def scene() -> Made:
    return made(3)


def pairs(features: FeatureGaussians) -> Matches:
    """Match the rows of the first view with those of the second; leave the others alone."""
    clusters = np.arange(len(features))
    second = np.flatnonzero(features.views == 1)
    clusters[second] = np.flatnonzero(features.views == 0)[: len(second)]
    ids, local = np.unique(clusters, return_inverse=True)
    return Matches(local, len(ids))


def contexts(scene: Made, networks: Networks) -> tuple[NetworkContext, TrainingContext]:
    place = scene.members, scene.scene.cameras
    return NetworkContext(networks.weights(), *place), TrainingContext(networks, *place)


@pytest.mark.parametrize("start", ["pooled", "first"])
def test_tensors_of_every_stage_are_those_of_its_kernels(scene: Made, start: str) -> None:
    networks = noisy_networks(replace(SMALL, merger_start=start))
    plain, training = contexts(scene, networks)
    _, order, cuts = cluster_runs(pairs(scene.features))
    expected = encode_features(scene.features, plain)
    actual = encode_features(features_to_tensors(scene.features), training)
    same(actual, expected)
    pooled = pool_runs(expected, order, cuts)
    same(pool_tensors(actual, order, cuts), pooled)
    expected = plain.merge(pooled, expected, order, cuts)
    actual = training.merge(pool_tensors(actual, order, cuts), actual, order, cuts)
    same(actual, expected)
    expected, actual = plain.refine(expected), training.refine(actual)
    same(actual, expected)
    base, other = plain.describe(expected), training.describe(actual)
    for name in ("frames", "sizes", "group"):
        np.testing.assert_allclose(as_array(getattr(other, name)), getattr(base, name), atol=2e-3, rtol=2e-3)
    for name, column in vars(feature_to_gaussians(expected)).items():
        if name != "quats":  # whose axes may have other signs
            np.testing.assert_allclose(as_array(getattr(other.base, name)), column, atol=2e-4, rtol=2e-3)


def same(actual: FeatureGaussians, expected: FeatureGaussians) -> None:
    arrays = features_to_arrays(actual)
    for f in fields(expected):
        one, other = getattr(arrays, f.name), getattr(expected, f.name)
        scale = float(np.abs(other).max()) if other.size else 1.0
        np.testing.assert_allclose(one, other, atol=1e-4 * scale, rtol=1e-3, err_msg=f.name)


def test_axes_turn_with_their_covariance() -> None:
    """Scales and rotations of a changed covariance, to first order."""
    generator = torch.Generator().manual_seed(0)
    turns = torch.linalg.qr(torch.randn(30, 3, 3, generator=generator))[0]
    covars = (turns * torch.tensor([0.2, 1.0, 3.0]).square()) @ turns.transpose(1, 2)
    weights = torch.randn(30, 3, 3, generator=generator)
    change = torch.randn(30, 3, 3, generator=generator)
    change = change + change.transpose(1, 2)

    def measure(values: torch.Tensor) -> torch.Tensor:
        scales, quats = differentiate_axes(values)
        axes = quat_to_rotmat(quats)  # outer products, since signs are arbitrary
        outer = (axes * scales[:, None].log()) @ axes.transpose(1, 2)
        return (outer * weights).sum()

    values = covars.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(measure(values), values)
    step = 1e-3
    difference = (measure(covars + step * change) - measure(covars - step * change)) / (2 * step)
    assert float((gradient * change).sum()) == pytest.approx(float(difference), rel=1e-2)


@cache
def tiny_example() -> Example:
    return make_example(make_training_scene(make_scene(room(), arc(2, 24, 18)), range(2)), PAPER, 0.1, "room")


@pytest.fixture
def fixed_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold clusters, neighbours, and what other views say of a group: they jump, and have no gradient."""
    example = tiny_example()
    matches = match(example.features, PAPER.match_options())
    assert matches.count < len(example.features)
    monkeypatch.setattr("gsmerge.research.training.predict.match", lambda *_: matches)

    def keep(module: object, name: str) -> None:
        first, function = dict[int, np.ndarray](), getattr(module, name)

        def kept(means: np.ndarray, *rest: object) -> np.ndarray:
            return first.setdefault(len(means), function(means, *rest)).copy()

        monkeypatch.setattr(module, name, kept)

    keep(apply, "find_neighbors")
    keep(tokens, "cross_view_stats")


def measure(crop: Crop, networks: Networks) -> torch.Tensor:
    """Return a smooth number that depends on every column of the children."""
    prediction = predict(crop, networks, PAPER, 0)
    g, generator = prediction.gaussians, torch.Generator().manual_seed(3)
    half = quat_to_rotmat(g.quats) * (g.scales / SIZE_OF_ROOM)[:, None]
    covars = (half @ half.transpose(1, 2)).flatten(1)
    values = torch.cat([g.means / SIZE_OF_ROOM, covars, 4 * g.opacities[:, None], 4 * g.sh0[:, 0]], 1).double()
    weights = 0.3 + torch.rand(values.shape, generator=generator, dtype=torch.float64)
    return (weights * torch.tanh(values)).sum()


@pytest.mark.usefixtures("fixed_choices")
@sweep("network", [PAPER.network, TINY])
@sweep("k", [1, 2, 4], often=0)
def test_gradients_are_central_differences(network: NetworkOptions, k: int) -> None:
    """For every column that a network makes: each reaches the children, through all stages after its own."""
    networks = noisy_networks(network, scale=0.15).requires_grad_(True)
    crop = whole_photo(tiny_example(), 0, k).crop
    rows = {"encoder.shift": {"shift": slice(0, 3)}, "encoder.latent": {"latent": slice(0, TINY.latent)}}
    rows |= {"merger.out": OF_FEATURES, "refiner.out": OF_FEATURES, f"heads.{k}.out": COLUMNS}
    for name, groups in rows.items():
        bias = networks.get_submodule(name).bias
        (actual,) = torch.autograd.grad(measure(crop, networks), [bias])
        differences = central_differences(lambda: measure(crop, networks), bias)
        size = differences.norm()
        for group, columns in groups.items():
            one, other = actual[columns], differences[columns]
            if other.norm() > 1e-3 * size:  # less than rounding otherwise
                assert float(torch.cosine_similarity(one, other, 0)) > 0.9, (name, group, one, other)
                assert float(one.norm() / other.norm()) == pytest.approx(1, abs=0.2), (name, group)


def central_differences(function: Callable[[], torch.Tensor], values: torch.Tensor, step: float = 1e-3) -> torch.Tensor:
    slopes = []
    with torch.no_grad():
        for place in range(len(values)):
            start, ends = values[place].item(), []
            for sign in (1, -1):
                values[place] = start + sign * step
                ends.append(float(function()))
            values[place] = start
            slopes.append((ends[0] - ends[1]) / (2 * step))
    return torch.tensor(slopes)
