"""Views that arrive in batches (method reference, case 53): fed twice, in reverse, in batches of any size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from view_batches import FAST, fed, parts_of, state_of

from gsmerge import Compactor, Scene
from gsmerge.plan import resolve_fit
from gsmerge.settings.compact import CompactOptions
from gsmerge.states.decode import decode_state
from gsmerge.states.groups import share

SHAPES = {"room": scenes.room, "wall": scenes.wall, "planes": scenes.two_planes}
FULL = {"fit": "full", "fit_steps": 30}


@pytest.fixture(scope="module")
def made() -> list[Scene]:
    """Three scenes of six views."""
    return [scenes.make_scene(shape(), scenes.arc(6, 48, 36), noise=0.005) for shape in SHAPES.values()]


def psnrs(compactors: Sequence[Compactor], made: Sequence[Scene], **wish: Any) -> np.ndarray:
    """PSNR (dB) of each over all of its scene's views, those of later batches and of earlier ones."""
    return np.array([scenes.psnr_of(c.decode(**wish), scene) for c, scene in zip(compactors, made, strict=True)])


@pytest.fixture(scope="module")
def forward(made: list[Scene]) -> list[Compactor]:
    return [fed(parts_of(scene, 2)) for scene in made]


@pytest.fixture(scope="module")
def whole(made: list[Scene]) -> list[Compactor]:
    return [fed([scene]) for scene in made]


# 53: the same batch twice


def test_a_batch_fed_twice(made: list[Scene]) -> None:
    once, twice = (fed([made[0]] * times) for times in (1, 2))
    assert len(once) <= len(twice) <= 1.02 * len(once)
    for wish in ({"fit": "none"}, FULL):
        assert psnrs([twice], made[:1], **wish) > psnrs([once], made[:1], **wish) - 0.2, wish


def test_batches_fed_again_and_again(made: list[Scene]) -> None:
    """Three times over all batches: what is there is enough after the first."""
    compactor, rounds = Compactor(**FAST), []
    for _ in range(3):
        for batch in parts_of(made[0], 2):
            compactor.extend(batch)
        rounds.append(len(compactor))
    assert rounds[1] <= 1.15 * rounds[0]
    assert rounds[2] - rounds[1] <= max(0.05 * rounds[0], rounds[1] - rounds[0])


# 53: batches in reverse


@pytest.mark.slow
@pytest.mark.parametrize("wishes", [[{"fit": "none"}], [FULL | {"fit_steps": n} for n in (30, 60, 200)]], ids=str)
def test_batches_in_reverse(wishes: list[dict[str, Any]], made: list[Scene], forward: list[Compactor]) -> None:
    """Within 0.2 dB on average over the scenes, 0.5 dB in each: tiny ones, of some 260 Gaussians.

    One fit rounds to 0.3 dB of either, so the mean of short and long ones counts.
    """
    backward = [fed(parts_of(scene, 2, backwards=True)) for scene in made]
    for one, other in zip(forward, backward, strict=True):
        assert abs(len(one) - len(other)) < 0.08 * len(one)
    differences = [psnrs(backward, made, **wish) - psnrs(forward, made, **wish) for wish in wishes]
    difference = np.mean(differences, 0)
    assert abs(difference.mean()) < 0.2
    assert np.abs(difference).max() < 0.5


# 53: batches of any size


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 1, 3])
def test_batches_of_any_size(size: int, made: list[Scene], whole: list[Compactor]) -> None:
    """For as many Gaussians, no more than 0.3 dB below all views at once, on average over the scenes.

    Both as others join them: a batch that is alone divides by its own pixels, which is worth 0.4 dB in so short a fit.
    The fewer the groups that batches leave, the more of these are divided: equal numbers are what compares.
    """
    options = resolve_fit(CompactOptions().with_settings(FULL))
    batched = [fed(parts_of(scene, size)) for scene in made]
    difference = []
    for scene, one, other in zip(made, whole, batched, strict=True):
        assert len(other) <= 1.1 * len(one)
        count = int(1.5 * len(one))
        states = [share(state_of(compactor)) for compactor in (one, other)]
        actual = [
            scenes.psnr_of(decode_state(state, budget=count, options=options).gaussians, scene) for state in states
        ]
        difference.append(actual[1] - actual[0])
    assert np.mean(difference) > -0.3


@pytest.mark.slow
def test_as_they_come_batches_need_no_more_gaussians(
    made: list[Scene], whole: list[Compactor], forward: list[Compactor], floor: Callable[..., None]
) -> None:
    """Decoded at K = 1, pairs of views give fewer Gaussians than all at once, and are hardly worse."""
    assert all(0.8 * len(one) < len(two) < len(one) for one, two in zip(whole, forward, strict=True))
    difference = psnrs(forward, made, **FULL) - psnrs(whole, made, **FULL)
    floor(difference.mean())


# 53: no view counts twice


def test_the_same_views_again_are_none_that_are_new(made: list[Scene], tmp_path: Path) -> None:
    """Neither their cameras nor their photos are kept twice, so that a limit on photos leaves room for others."""
    one, two = (fed([made[0]] * times, replay=6) for times in (1, 2))
    assert len(state_of(two).cameras) == 6
    assert state_of(two).replay.views.tolist() == list(range(6))
    np.testing.assert_array_equal(state_of(two).replay.images, state_of(one).replay.images)
    for name, compactor in (("a.gsm", one), ("b.gsm", two)):
        compactor.save(tmp_path / name)
    assert (tmp_path / "b.gsm").stat().st_size < 1.02 * (tmp_path / "a.gsm").stat().st_size
