"""Made scenes whose views arrive in batches, and states that were made of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import scenes

from gsmerge import Compactor, Scene
from gsmerge.fit import FitOptions
from gsmerge.kernels import elementary
from gsmerge.stages.merge import take
from gsmerge.states.decode import decode_state
from gsmerge.states.state import DividedGroups, GroupSet, Learned, State
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians

FAST: dict[str, Any] = {"superpixels": "10%", "checkpoint": "none"}


def room(num_views: int = 6, width: int = 36, height: int = 24, **settings: Any) -> Scene:
    """Views side by side of a ball before a wall."""
    return scenes.make_scene(scenes.room(), scenes.arc(num_views, width, height), noise=0.005, **settings)


def parts_of(scene: Scene, size: int, *, backwards: bool = False) -> list[Scene]:
    """The scene's views in batches of a size, the first or the last first."""
    actual = [
        scenes.take_views(scene, range(first, min(first + size, len(scene)))) for first in range(0, len(scene), size)
    ]
    return actual[::-1] if backwards else actual


def fed(batches: Iterable[Scene], **settings: Any) -> Compactor:
    """What becomes of batches, one after the other."""
    compactor = Compactor(**{**FAST, **settings})
    for batch in batches:
        compactor.extend(batch)
    return compactor


def state_of(compactor: Compactor) -> State:
    """The state, which must be there."""
    return compactor.state


def one_batch(scene: Scene, **settings: Any) -> State:
    """The state of a scene alone."""
    compactor = Compactor(**settings)
    compactor.extend(scene)
    return state_of(compactor)


def decoded(state: State, **wish: Any) -> Gaussians:
    """What a state is without a fit."""
    return decode_state(state, options=FitOptions(fit="none"), **wish).gaussians


def same_state(one: State, other: State) -> None:
    """To the last bit, and in everything that is told."""
    assert type(one.groups) is type(other.groups)
    if isinstance(one.groups, GroupSet) and isinstance(other.groups, GroupSet):
        same_groups(one.groups, other.groups)
    elif isinstance(one.groups, DividedGroups) and isinstance(other.groups, DividedGroups):
        same_divided(one.groups, other.groups)
    assert scenes.identical(one.kept, other.kept)
    np.testing.assert_array_equal(one.frame.origin, other.frame.origin)
    assert one.frame.unit == other.frame.unit
    for name in ("viewmats", "Ks"):
        np.testing.assert_array_equal(getattr(one.cameras, name), getattr(other.cameras, name), name)
    assert (one.cameras.width, one.cameras.height) == (other.cameras.width, other.cameras.height)
    np.testing.assert_array_equal(one.replay.images, other.replay.images)
    np.testing.assert_array_equal(one.replay.views, other.replay.views)
    assert asdict(one.settings) == asdict(other.settings)
    assert one.about == other.about
    assert (one.networks is None) == (other.networks is None)
    if one.networks is not None:
        for name in ("means", "opacities", "sh0"):
            np.testing.assert_array_equal(getattr(one.networks.samples, name), getattr(other.networks.samples, name))
        assert one.networks.weights.options == other.networks.weights.options
        arrays = one.networks.weights.arrays
        assert all(np.array_equal(array, other.networks.weights.arrays[name]) for name, array in arrays.items())


def same_divided(one: DividedGroups, other: DividedGroups) -> None:
    """To the last bit, types included."""
    same_features(one.features, other.features)
    same_learned(one.learned, other.learned)
    for name in ("splits", "slots", "uniform", "growth_order"):
        a, b = getattr(one.division, name), getattr(other.division, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, name)
    assert scenes.identical(one.division.children, other.division.children)
    same_saliency(one.saliency, other.saliency)
    for part, names in {"heads": ("views", "group"), "colors": ("sh0", "precision")}.items():
        a, b = getattr(one, part), getattr(other, part)
        assert (a is None) == (b is None), part
        for name in names if a is not None else ():
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), f"{part}.{name}")


def same_saliency(one: np.ndarray | None, other: np.ndarray | None) -> None:
    """To the last bit; files of 0.1 have none."""
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert one.dtype == other.dtype == np.float64
        np.testing.assert_array_equal(one, other)


def same_learned(one: Learned | None, other: Learned | None) -> None:
    """To the last bit, types included."""
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        same_features(one.refined, other.refined)
        np.testing.assert_array_equal(one.views, other.views)
        np.testing.assert_array_equal(one.num_members, other.num_members)


def same_groups(one: GroupSet, other: GroupSet) -> None:
    """To the last bit, types included."""
    same_features(one.features, other.features)
    same_learned(one.learned, other.learned)
    same_saliency(one.saliency, other.saliency)
    assert scenes.identical(one.children, other.children)
    np.testing.assert_array_equal(one.colors.sh0, other.colors.sh0)
    np.testing.assert_array_equal(one.colors.precision, other.colors.precision)


def same_features(one: FeatureGaussians, other: FeatureGaussians) -> None:
    """To the last bit, types included."""
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        assert a.dtype == b.dtype, f.name
        np.testing.assert_array_equal(a, b, f.name)


def group(groups: GroupSet, row: int) -> tuple[dict[str, np.ndarray], Gaussians]:
    """One group's columns and its children."""
    one = take(groups.features, np.array([row]))
    names = [f.name for f in fields(one) if f.name not in ("starts", "members")]
    columns = {name: getattr(one, name) for name in names}
    columns |= {"fitted_sh0": groups.colors.sh0[row], "color_precision": groups.colors.precision[row]}
    return columns, groups.children[one.members]


def same_group(one: GroupSet, row: int, other: GroupSet, place: int) -> bool:
    """Whether a group of one is a group of the other, to the last bit."""
    (columns, children), (others, those) = group(one, row), group(other, place)
    return scenes.identical(children, those) and all(np.array_equal(columns[name], others[name]) for name in columns)


def random_gaussians(count: int, seed: int, *, size: tuple[float, float] = (0.01, 0.2), degree: int = 0) -> Gaussians:
    """Gaussians of any shape, turned at random, before and beside the cameras of :func:`scenes.arc`."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    low, high = elementary.log(size)

    columns = (
        rng.uniform([-4, -4, -2], [4, 4, 6], (count, 3)),
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        elementary.exp(rng.uniform(low, high, (count, 3))),
        rng.uniform(0.05, 0.99, count),
        rng.uniform(-1, 1, (count, 1, 3)) / SH_C0 / 2,
        rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)) / 9,
    )
    return Gaussians(*(column.astype(np.float32) for column in columns))


def counts(reports: Sequence[Any], name: str) -> list[int]:
    """One number of every report."""
    return [getattr(report, name) for report in reports]
