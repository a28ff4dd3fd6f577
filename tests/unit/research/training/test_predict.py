"""Tensors go through the stages as the kernels' arrays do, and their gradients are central differences."""

from __future__ import annotations

from collections import Counter
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
from gsmerge.method.geometry.pooling import MAX_OPACITY, feature_to_gaussians, pool_members
from gsmerge.method.geometry.transforms import rotmat_to_quat
from gsmerge.method.kernels import elementary
from gsmerge.method.networks import apply, tokens
from gsmerge.method.networks.apply import NetworkContext, encode_features
from gsmerge.method.networks.corrections import (
    COLOR_COLUMNS,
    LOGIT_COLUMN,
    MASS_COLUMN,
    MEAN_COLUMNS,
    ROTATION_COLUMNS,
    SIZE_COLUMNS,
)
from gsmerge.method.networks.options import FEATURE, NetworkOptions
from gsmerge.method.networks.tensors import quat_to_rotmat
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import cluster_runs, merge, pool_runs
from gsmerge.research.training import Example, make_example, make_training_scene, preset_options
from gsmerge.research.training.examples import draw_random_views, select_example_views
from gsmerge.research.training.losses import teacher_loss, window_loss
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.predict import (
    Prediction,
    TrainingContext,
    differentiate_axes,
    features_to_arrays,
    features_to_tensors,
    pool_tensors,
    predict,
)
from gsmerge.research.training.windows import Crop, Window, sample_window
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians, Matches

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
@sweep(("network", "k"), [(PAPER.network, 1), (PAPER.network, 4), (TINY, 2), (TINY, 4)], often=0)
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


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(make_training_scene(make_scene(room(), arc(4, 32, 24)), range(4)), PAPER, 0.1, "room")


def windows(example: Example, count: int) -> list[Window]:
    rng = np.random.default_rng(0)
    drawn = (draw_random_views(example, PAPER, rng) for _ in range(count))
    return [sample_window(part, PAPER.levels, PAPER.window, PAPER.most, 0.5, rng) for part in drawn]


def test_photos_have_the_longer_side_that_is_asked_for() -> None:
    training = make_training_scene(make_scene(room(), arc(2, 48, 36)), range(2))
    small = make_example(training, replace(PAPER, photo_side=32), 0.1, "room")
    assert small.images.shape == (2, 24, 32, 3)
    assert small.covers.shape == (2, 2, 24, 32)
    np.testing.assert_allclose(small.photos.Ks[0, :2] * 1.5, training.cameras.Ks[0, :2], rtol=1e-6)
    assert make_example(training, replace(PAPER, photo_side=476), 0.1, "room").images.shape == (2, 36, 48, 3)


def test_every_window_draws_its_own_views(example: Example) -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_random_views(example, PAPER, rng) for _ in range(80)]
    counts = Counter(len(part.cameras) for part in drawn)
    assert set(counts) == {1, 2, 3, 4}
    assert min(counts.values()) > 9
    few = replace(PAPER, random_views=(2, 3))
    assert {len(draw_random_views(example, few, rng).cameras) for _ in range(20)} == {2, 3}


def test_views_taken_from_an_example_are_an_example_of_those_views(example: Example) -> None:
    """As if it had been made of them, apart from the frame."""
    part = select_example_views(example, [1, 3])
    pixels = 32 * 24
    assert (len(part.cameras), len(part.photos), part.covers.shape[:2]) == (2, 4, (2, 4))
    np.testing.assert_array_equal(part.cameras.viewmats, example.cameras.viewmats[[1, 3]])
    np.testing.assert_array_equal(part.members.means[:pixels], example.members.means[pixels : 2 * pixels])
    np.testing.assert_array_equal(part.images, example.images[[1, 3, 0, 2]])
    np.testing.assert_array_equal(part.covers[1, 2], example.covers[3, 0])
    rows = np.isin(example.features.views, [1, 3])
    np.testing.assert_array_equal(part.base.means, example.base.means[rows])
    assert set(part.features.views.tolist()) == {0, 1}
    for row in range(0, len(part.features), 17):
        own = part.features.members[part.features.starts[row] : part.features.starts[row + 1]]
        assert set((own // pixels).tolist()) == {int(part.features.views[row])}
        weights = part.members.opacities[own]
        mean = (weights[:, None] * part.members.means[own]).sum(0) / weights.sum()
        np.testing.assert_allclose(part.features.means[row], mean, atol=1e-4)
    assert part.mask(2).sum() <= example.mask(0).sum()
    assert select_example_views(example, range(4)) is example


def test_the_preset_s_examples_have_clusters(example: Example) -> None:
    """Boxes of one surface that is seen from two places hardly ever share 0.7, which was their limit once."""
    paper = preset_options("paper")
    sizes = np.bincount(match(example.features, paper.match_options()).clusters)
    assert float(sizes[sizes > 1].sum()) > 0.1 * len(example.features)
    strict = np.bincount(match(example.features, replace(paper, iou=0.7).match_options()).clusters)
    assert int(strict[strict > 1].sum()) < 0.5 * int(sizes[sizes > 1].sum())
    shares = [predict(window.crop, noisy_networks(TINY), PAPER, 0).matched for window in windows(example, 6)]
    assert max(shares) > 0.1


@pytest.mark.slow
def test_every_network_gets_a_gradient(example: Example) -> None:
    networks = noisy_networks(replace(TINY, outputs="absolute")).requires_grad_(True)
    sums: Counter[str] = Counter()
    for window in windows(example, 4):
        loss = window_loss(networks, window, PAPER, 0, np.random.default_rng(0))
        names, parameters = zip(*networks.named_parameters(), strict=True)
        for name, part in zip(names, torch.autograd.grad(loss, parameters, allow_unused=True), strict=True):
            if part is not None:
                sums[name.partition(".")[0] + name.partition("heads.")[2][:1]] += float(part.abs().sum())
    assert {name for name, value in sums.items() if value > 0} == {"encoder", "merger", "refiner", "heads1", "heads2"}


def teacher_of(example: Example) -> Prediction:
    """Return the Gaussians of the paper's two equations, by hand, for a whole example."""
    m, merged = example.members, merge(example.features, match(example.features, PAPER.match_options()))
    means, covars, colors = [], [], []
    for first, last in zip(merged.starts[:-1].tolist(), merged.starts[1:].tolist(), strict=True):
        ids = merged.members[first:last]
        weights, points = m.opacities[ids].astype(float)[:, None], m.means[ids].astype(float)
        means.append((weights * points).sum(0) / weights.sum())  # eq. teacher_mean
        colors.append((weights * m.sh0[ids, 0]).sum(0) / weights.sum())
        offsets = points - means[-1]
        covars.append((weights * offsets).T @ offsets / weights.sum())  # eq. teacher_cov
    floor = (0.1 * merged.footprints.astype(float))[:, None, None] ** 2 * np.eye(3)  # one pixel has no spread
    values, axes = np.linalg.eigh(np.stack(covars) + floor)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    count = len(merged)
    columns = np.stack(means), rotmat_to_quat(axes), np.sqrt(values)
    depths = (pool_members(m, merged.starts, merged.members, "paper").extinctions) / (
        columns[2][:, 1] * columns[2][:, 2]
    )
    gaussians = Gaussians(
        *(torch.from_numpy(column).float() for column in columns),
        torch.from_numpy(1 - elementary.exp(-depths)).float().clamp(0, MAX_OPACITY),
        torch.from_numpy(np.stack(colors)).float()[:, None], torch.zeros(count, 0, 3),
    )  # fmt: skip
    return Prediction(gaussians, torch.arange(count), merged, torch.ones(count), 0.0)


def test_the_teacher_is_the_paper_s_two_equations(example: Example) -> None:
    exact = teacher_of(example)
    assert int((exact.merged.views < 0).sum()) > 0  # clusters too
    assert float(teacher_loss(exact, example.members)) < 0.02  # rounding of nearly round ones
    g = exact.gaussians
    fainter = replace(exact, gaussians=replace(g, opacities=g.opacities - 0.1))
    assert float(teacher_loss(fainter, example.members)) == pytest.approx(0.1, abs=0.02)
    lighter = replace(exact, gaussians=replace(g, sh0=g.sh0 + 0.2 / SH_C0))
    assert float(teacher_loss(lighter, example.members)) == pytest.approx(0.2, abs=0.02)
    wider = replace(exact, gaussians=replace(g, scales=g.scales * 2))
    difference = float(teacher_loss(wider, example.members)) - float(teacher_loss(exact, example.members))
    assert difference == pytest.approx(np.log(2), abs=1e-3)
    turned = replace(exact, gaussians=replace(g, quats=turn(g.quats, 0.2)))
    assert float(teacher_loss(turned, example.members)) == pytest.approx(0.2, abs=0.04)
    sizes = (g.scales[:, 1] * g.scales[:, 2]).sqrt()
    moved = replace(exact, gaussians=replace(g, means=g.means + 0.3 * sizes[:, None]))
    assert float(teacher_loss(moved, example.members)) == pytest.approx(0.3, abs=0.02)


def turn(quats: torch.Tensor, angle: float) -> torch.Tensor:
    """Return rotations turned about the first axis of the world."""
    w, x, y, z = quats.unbind(1)
    c, s = elementary.cos(angle / 2), elementary.sin(angle / 2)
    return torch.stack([c * w - s * x, c * x + s * w, c * y - s * z, c * z + s * y], 1)


def test_axes_in_another_order_are_the_same_gaussian(example: Example) -> None:
    exact = teacher_of(example)
    g = exact.gaussians
    cycled = torch.from_numpy(rotmat_to_quat(quat_to_rotmat(g.quats)[:, :, [1, 2, 0]].numpy()))
    other = replace(exact, gaussians=replace(g, quats=cycled, scales=g.scales[:, [1, 2, 0]]))
    assert float(teacher_loss(other, example.members)) < 0.02


@pytest.mark.parametrize("name", ["means", "quats", "scales"])
def test_gradient_of_the_teacher_is_that_of_finite_differences(example: Example, name: str) -> None:
    exact = teacher_of(example)
    g, generator = exact.gaussians, torch.Generator().manual_seed(0)
    start = replace(g, means=g.means + 0.1 * g.scales.max(), scales=g.scales * 1.3, quats=turn(g.quats, 0.1))
    value = getattr(start, name).clone().requires_grad_(True)
    direction = torch.randn(value.shape, generator=generator) * (g.scales if name != "quats" else 0.1)

    def loss(tensor: torch.Tensor) -> torch.Tensor:
        return teacher_loss(replace(exact, gaussians=replace(start, **{name: tensor})), example.members)

    (gradient,) = torch.autograd.grad(loss(value), value)
    with torch.no_grad():
        ends = [float(loss(value + step * direction)) for step in (1e-2, -1e-2)]
    assert float((gradient * direction).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-2, rel=0.05, abs=2e-3)
