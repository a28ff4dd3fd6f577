"""Phases of a step read and write nothing outside the buffers on any numbers, as sanitizers would see.

That the bits are those of a slow twin is in ``tests/unit/method/fit/test_steps.py``.
"""

from contextlib import suppress

import numpy as np
import pytest
from messages import refuses

from gsmerge.method.fit.fit_state import FitState, start_state
from gsmerge.method.fit.step_buffers import OF_STEP, StepBuffers
from gsmerge.method.kernels.raster.project import POSE
from gsmerge.method.kernels.raster.step import PHASES, STEP, fit_phase
from gsmerge.method.kernels.signature import FilledTable
from gsmerge.method.raster import tiled_view
from gsmerge.method.raster.tiled_view import camera_numbers
from gsmerge.types import Gaussians

WIDTH, HEIGHT = 37, 21
HOSTILE = np.array([0, -0.0, 1, -1, 1e-40, 1e30, -1e30, 3e38, np.nan, np.inf, -np.inf], np.float32)


def some_state(count: int, rng: np.random.Generator, num: int = 0) -> FitState:
    """Return a state of Gaussians with so many higher harmonics; some are fixed."""
    means = rng.normal(0, 1, (count, 3))
    means[:, 2] += 4
    colors, shN = rng.normal(0, 1, (count, 1, 3)), rng.normal(0, 1, (count, num, 3)).astype(np.float32)
    columns = means, rng.normal(0, 1, (count, 4)), rng.uniform(0.01, 0.5, (count, 3)), rng.uniform(0, 1, count), colors
    state = start_state(Gaussians(*(column.astype(np.float32) for column in columns), shN))
    state.fixed[::5] = True
    return state


def step_numbers(rng: np.random.Generator) -> dict[str, np.ndarray]:
    K = np.array([[30, 0, WIDTH / 2], [0, 30, HEIGHT / 2], [0, 0, 1]])
    numbers = {name: rng.uniform(0, 0.1, size).astype(np.float32) for name, size in OF_STEP.items()}
    return numbers | {"camera": camera_numbers(np.eye(4), K, WIDTH, HEIGHT, 0.3, False)}


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("num", [0, 8])
@pytest.mark.parametrize("many", [1 << 24, 0])  # whether lists are cut
@pytest.mark.parametrize("seed", range(12))
def test_hostile_numbers_come_to_an_end(
    seed: int, many: int, num: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiled_view, "CROWDED", many)
    monkeypatch.setattr(tiled_view, "CROWDED_EACH", 0)
    rng = np.random.default_rng(seed)
    state, numbers = some_state(300, rng, num), step_numbers(rng)
    photo, weight = (rng.random((HEIGHT, WIDTH, *more), dtype=np.float32) for more in ((3,), ()))
    buffers = StepBuffers(state, threads, moves_camera=True)
    buffers.take_step(1, photo, weight, state.splats.opacities, numbers)
    arrays = [state.x, state.x0, state.m, state.v, *vars(state.splats).values(), photo, weight, *numbers.values()]
    arrays = [array for array in arrays if array.size]
    for number in range(2, 12):
        array = arrays[rng.integers(len(arrays))].reshape(-1)
        array[rng.integers(0, array.size, max(1, array.size // 4))] = rng.choice(HOSTILE)
        with np.errstate(all="ignore"), suppress(ValueError):  # of a camera whose picture has another size
            buffers.take_step(number, photo, weight, state.splats.opacities, numbers)


def test_views_that_show_nothing_take_a_step() -> None:
    rng = np.random.default_rng(0)
    state, numbers = some_state(5, rng), step_numbers(rng)
    state.splats.means[:, 2] = -1
    photo, weight = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.ones((HEIGHT, WIDTH), np.float32)
    error, viewmat_gradient = StepBuffers(state, 2).take_step(1, photo, weight, state.splats.opacities, numbers)
    assert viewmat_gradient is None
    assert error == pytest.approx(
        HEIGHT * WIDTH * float((numbers["background"].astype(np.float64) ** 2).sum()), rel=1e-5
    )


@pytest.mark.parametrize("name", ["offsets", "corners", "counts", "num_kept", "g_poses", "flatten_ids"])
def test_buffers_of_another_size_are_refused(name: str) -> None:
    rng = np.random.default_rng(0)
    state, numbers = some_state(300, rng), step_numbers(rng)
    photo, weight = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.ones((HEIGHT, WIDTH), np.float32)
    buffers = StepBuffers(state, 1, moves_camera=True)
    buffers.take_step(1, photo, weight, state.splats.opacities, numbers)
    ((table, _),) = buffers.tables.values()
    arrays = dict(table.arrays)
    arrays[name] = np.zeros(tuple(size + 1 for size in arrays[name].shape), arrays[name].dtype)
    if name == "g_poses":
        arrays[name] = np.zeros((table["blocks"] + 1, POSE), np.float32)
    if name == "flatten_ids":
        arrays |= {"flatten_ids": np.zeros(1, np.int32), "slots": np.zeros((1, 9), np.float32)}
    if name == "corners":
        arrays["corners"] = np.zeros((2, table["num_corners"] + 1), np.int64)
    if name == "counts":
        arrays |= {
            "counts": np.zeros((2, table["tiles"] + 1), np.int64),
            "light": np.zeros(table["tiles"] + 1, np.float32),
        }
    short = FilledTable(STEP, arrays)
    with refuses(ValueError, "fit_phase"):
        for phase in range(len(PHASES)):
            fit_phase.prepare(short.values, phase)()


def test_a_table_of_another_size_is_refused() -> None:
    with refuses(ValueError, "fit_phase"):
        fit_phase(np.zeros(3, np.int64), 0)
