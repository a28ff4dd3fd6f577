from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from messages import refuses

from gsmerge.arrays import as_array, as_tensor, distinct, like
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Groups, Pixels, Scene, Views, make_scene


def gaussians(n: int, coefficients: int = 0, start: int = 0) -> Gaussians:
    def rows(*shape: int) -> np.ndarray:
        return np.arange(start, start + n, dtype=np.float32).reshape(n, *[1] * len(shape)) * np.ones(shape, np.float32)

    return Gaussians(rows(3), rows(4), rows(3), rows(), rows(1, 3), rows(coefficients, 3))


def cameras(c: int = 2) -> Cameras:
    return Cameras(np.stack([np.eye(4)] * c), np.stack([np.eye(3)] * c), 4, 3)


def features(sizes: list[int]) -> FeatureGaussians:
    g, starts = len(sizes), np.cumsum([0, *sizes])
    column = np.arange(g, dtype=np.float32)
    return FeatureGaussians(
        means=np.stack([column] * 3, 1), covars=column[:, None, None] * np.ones((3, 3), np.float32), weights=column,
        masses=column, extinctions=column, gains=column, sh0=np.zeros((g, 1, 3), np.float32),
        shN=np.zeros((g, 0, 3), np.float32), footprints=column, views=np.arange(g),
        starts=starts, members=np.arange(starts[-1]), latents=np.zeros((g, 0), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("values", [[], [3], [2, 2], [5, -1, 5, 0, -1]])
def test_distinct_values_ascend(values: list[int]) -> None:
    assert distinct(np.array(values, np.int64)).tolist() == sorted(set(values))


@pytest.mark.parametrize("filled", [[False, False, True, True], [True, False, False, True]])
def test_gaussians_of_the_file_do_not_fill_holes(filled: list[bool]) -> None:
    scene = replace(make_scene(gaussians(4), cameras()), filled=np.array(filled))
    assert scene.file_gaussians.opacities.tolist() == [row for row in range(4) if not filled[row]]


def test_concat_keeps_the_order() -> None:
    both = Gaussians.concat([gaussians(2, 3), gaussians(3, 3, start=2)])
    for f in fields(Gaussians):
        assert np.array_equal(getattr(both, f.name), getattr(gaussians(5, 3), f.name))


def test_gaussians_moved_to_a_device_keep_their_values(torch: Any) -> None:
    """Arrays become tensors that share their memory, and tensors arrays; of either kind the same stays as it is."""
    g, c = gaussians(2, 3), cameras()
    tensors, moved = g.to("cpu"), c.to(torch.device("cpu"))
    assert (moved.width, moved.height) == (4, 3)
    for one, other in ((g, tensors), (c, moved)):
        back = other.numpy()
        for name in ("viewmats", "Ks") if one is c else [f.name for f in fields(Gaussians)]:
            array, tensor = getattr(one, name), getattr(other, name)
            assert isinstance(tensor, torch.Tensor)
            assert isinstance(getattr(back, name), np.ndarray)
            assert torch.equal(tensor, torch.from_numpy(array))
            assert np.shares_memory(getattr(back, name), array)
            assert getattr(other.to("cpu"), name) is tensor
            assert getattr(one.numpy(), name) is array
    assert all(getattr(g.to("meta"), f.name).is_meta for f in fields(Gaussians))


def test_gradients_pass_to_a_device_and_end_in_arrays(torch: Any) -> None:
    means = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
    tensors = replace(gaussians(2).to("cpu"), means=means)
    tensors.to("cpu").means.sum().backward()
    viewmats = torch.eye(4)[None].requires_grad_()
    assert Cameras(viewmats, torch.eye(3)[None], 4, 3).to("cpu").viewmats.requires_grad
    assert tensors.numpy().means.tolist() == [[1, 1, 1]] * 2
    assert tensors.numpy().means.dtype == np.float64


def test_concat_of_tensors_is_of_tensors(torch: Any) -> None:
    """With their gradients; arrays among them become tensors."""
    opacities = torch.ones(2, requires_grad=True)
    first = replace(gaussians(2, 3).to("cpu"), opacities=opacities)
    for second in (gaussians(3, 3, start=2), gaussians(3, 3, start=2).to("cpu")):
        both = Gaussians.concat([first, second])
        assert both.device == torch.device("cpu")
        assert both.opacities.requires_grad
        assert both.opacities.tolist() == [1, 1, 2, 3, 4]
        for name in ("means", "quats", "scales", "sh0", "shN"):
            assert np.array_equal(getattr(both.numpy(), name), getattr(gaussians(5, 3), name))


def test_tensors_are_indexed_like_arrays(torch: Any) -> None:
    g = gaussians(5, 3)
    for index in (slice(1, 3), np.array([4, 0]), g.opacities > 2, [3]):
        actual, expected = g.to("cpu")[index], g[index]
        assert actual.device is not None
        for f in fields(Gaussians):
            assert np.array_equal(getattr(actual.numpy(), f.name), getattr(expected, f.name))


def test_arrays_and_tensors_become_each_other_without_a_copy(torch: Any) -> None:
    array, tensor = np.arange(3.0), torch.arange(3.0, requires_grad=True)
    assert as_array(array) is array
    assert np.shares_memory(as_array(as_tensor(array)), array)
    assert as_tensor(tensor) is tensor
    assert as_array(tensor).tolist() == as_array([0.0, 1.0, 2.0]).tolist() == [0, 1, 2]
    assert like(array, np.zeros(1)) is array
    assert torch.equal(like(array, torch.zeros(1)), torch.from_numpy(array))
    assert like(array, torch.zeros(1, device="meta")).is_meta


def test_incomplete_harmonics_are_refused() -> None:
    with refuses(ValueError, "shN", 24, 5):
        gaussians(2, 5)


def test_cameras_are_counted_cut_and_have_centres() -> None:
    c = cameras(3)
    assert len(c) == 3
    assert len(c[:1]) == 1
    assert (c[1:].width, c[1:].height) == (4, 3)
    viewmat = np.array([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])
    turned = replace(c, viewmats=np.stack([viewmat] * 3))
    assert turned.centres[0].tolist() == [7, -6, -5]


def test_cameras_of_tensors_have_centres(torch: Any) -> None:
    viewmat = torch.tensor([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])
    assert Cameras(viewmat[None], torch.eye(3)[None], 4, 3).centres[0].tolist() == [7, -6, -5]


def scene() -> Scene:
    images, valid = np.zeros((2, 3, 4, 3), np.float32), np.ones((2, 3, 4), bool)
    return Scene(gaussians(24), cameras(), images, Pixels.of_grid(valid), ("a", "b"))


def test_equal_scenes_are_equal(torch: Any) -> None:
    for one in (scene(), scene().pixels, make_scene(gaussians(2).to("cpu"), cameras())):
        assert copy.deepcopy(one) == one
    assert scene() in [replace(scene(), images=None), scene()]
    assert replace(scene(), names=("a", "c")) != scene() != replace(scene(), gaussians=gaussians(24, start=1))


def test_pixels_of_a_grid_with_gaps_leave_the_gaps_out() -> None:
    shown = np.ones((2, 3, 4), bool)
    shown[1, 2, 3] = shown[0, 0, 1] = False
    pixels = Pixels.of_grid(shown)
    assert pixels.homes.tolist() == np.flatnonzero(shown).tolist()
    assert np.array_equal(pixels.shown, shown)
    assert np.array_equal(pixels.homes[pixels.fronts[shown]], np.flatnonzero(shown))
    assert scene().covered is None
    assert np.array_equal(replace(scene(), gaussians=gaussians(22), pixels=pixels).covered, shown)


@pytest.mark.parametrize("views", [[0], [1], [1, 0], [0, 0, 1]])
def test_pixels_of_some_views_keep_their_rows(views: list[int]) -> None:
    shown = np.random.default_rng(0).random((2, 3, 4)) < 0.7
    pixels = Pixels.of_grid(shown)
    order = np.random.default_rng(1).permutation(len(pixels.homes))
    for whole in (
        pixels,
        Pixels(pixels.homes[order], np.where(shown, np.argsort(order, kind="stable")[pixels.fronts], -1), own=True),
    ):
        rows, part = whole.select(views)
        assert np.array_equal(part.shown, shown[views])
        assert np.array_equal(rows[part.fronts[part.shown]], whole.fronts[views][part.shown])
        assert np.array_equal(part.homes % 12, whole.homes[rows] % 12)
        assert np.array_equal(np.asarray(views)[part.homes // 12], whole.homes[rows] // 12)


OTHER_TYPES: list[tuple[Callable[[], Any], str, list[object]]] = [
    (lambda: replace(gaussians(1), means=[[0, 0, 0]]), "means", ["list"]),
    (lambda: replace(gaussians(1), quats="quats"), "quats", ["str"]),
    (lambda: replace(gaussians(1), shN=None), "shN", ["NoneType"]),
    (lambda: replace(cameras(), viewmats=None), "viewmats", ["NoneType"]),
    (lambda: replace(cameras(), width="4"), "width", ["str"]),
    (lambda: replace(cameras(), height=3.0), "height", ["float"]),
    (lambda: replace(scene(), images="x"), "images", ["str"]),
    (lambda: replace(scene(), pixels=np.zeros(3)), "pixels", ["ndarray"]),
    (lambda: replace(scene(), names="ab"), "names", ["str"]),
    (lambda: replace(scene(), gaussians=cameras()), "gaussians", ["Cameras"]),
    (lambda: Views(cameras(), None, ("a", "b")), "images", ["NoneType"]),
    (lambda: gaussians(3)[2], "gaussians", ["gaussians[[2]]"]),
    (lambda: gaussians(3)[None], "gaussians", ["NoneType"]),
    (lambda: list(cameras()), "cameras", ["cameras[[0]]"]),
    (lambda: cameras()[np.int64(1)], "cameras", ["cameras[[1]]"]),
    (lambda: views()[-1], "views", ["views[[-1]]"]),
]


@pytest.mark.parametrize(("call", "place", "values"), OTHER_TYPES)
def test_other_types_are_refused(call: Callable[[], Any], place: str, values: list[object]) -> None:
    with refuses(TypeError, place, *values):
        call()


def views() -> Views:
    return Views(cameras(), np.zeros((2, 3, 4, 3)), ("a", "b"))


@pytest.mark.parametrize("index", [slice(1, 2), [1], (1,), np.array([1]), np.array([False, True]), range(1, 2)])
def test_an_index_selects_rows(index: Any) -> None:
    assert views()[index] == Views(cameras(1), np.zeros((1, 3, 4, 3)), ("b",))
    assert gaussians(2)[index] == gaussians(1, start=1)


def test_a_scene_may_have_no_cameras() -> None:
    for bare in (
        Scene(gaussians(2), None, None, None, ()),  # type: ignore[arg-type]
        replace(scene(), cameras=None, images=None, pixels=None, names=None),
    ):
        assert (len(bare), len(bare.cameras), bare.names) == (0, 0, ())
    assert replace(scene(), names=None).names == make_scene(gaussians(2), cameras()).names


def test_arrays_are_described_by_their_shape() -> None:
    assert repr(scene().pixels) == "Pixels(homes=ndarray[24], fronts=ndarray[2, 3, 4], own=True)"


def test_groups_count_all_views() -> None:
    assert len(Groups(np.zeros((2, 3, 4), np.int32), (3, 4))) == 7
    with refuses(ValueError, "labels", [2, 3, 4]):
        Groups(np.zeros((2, 3, 4), np.int32), (3,))


def test_features_concat_shifts_the_starts() -> None:
    both = FeatureGaussians.concat([features([2, 1]), features([3])])
    assert len(both) == 3
    assert both.starts.tolist() == [0, 2, 3, 6]
    assert both.members.tolist() == [0, 1, 2, 0, 1, 2]
    assert both.weights.tolist() == [0, 1, 0]


WRONG: list[tuple[Callable[[], Any], dict[str, Any], tuple[object, ...]]] = [
    *((partial(gaussians, 5), {name: np.zeros(shape)}, (name, list(shape))) for name, shape in (
        ("means", (5, 2)), ("quats", (5, 3)), ("scales", (4, 3)), ("opacities", (5, 1)), ("sh0", (5, 3)),
        ("shN", (5, 3)),
    )),
    (cameras, {"viewmats": np.stack([np.eye(3)] * 2)}, ("viewmats", "[c, 4, 4]", [2, 3, 3])),
    (cameras, {"Ks": np.eye(3)[None]}, ("Ks", [2, 3, 3], [1, 3, 3])),
    (cameras, {"width": 0}, ("", "0 x 3")),
    (cameras, {"height": -1}, ("", "4 x -1")),
    (scene, {"gaussians": gaussians(23)}, ("homes", [23], [24])),
    (scene, {"pixels": Pixels.of_grid(np.ones((1, 6, 4)))}, ("fronts", [2, 3, 4], [1, 6, 4])),
    (scene, {"images": np.zeros((2, 3, 4, 4))}, ("images", [2, 3, 4, 3], [2, 3, 4, 4])),
    (scene, {"names": ("a",)}, ("", 2, "names", 1)),
    (scene, {"masks": np.ones((2, 4, 3), bool)}, ("masks", [2, 3, 4], [2, 4, 3])),
    (views, {"images": np.zeros((2, 4, 3, 3))}, ("images", [2, 3, 4, 3], [2, 4, 3, 3])),
    (views, {"names": ("a",)}, ("", 2, 1)),
    *((partial(features, [1, 2]), {name: np.zeros(7)}, (name, [7]))
      for name in ("weights", "masses", "extinctions", "gains", "footprints", "starts")),
]  # fmt: skip


@pytest.mark.parametrize(
    ("make", "change", "named"), WRONG, ids=lambda value: ",".join(value) if isinstance(value, dict) else ""
)
def test_arrays_of_wrong_shapes_are_refused(
    make: Callable[[], Any], change: dict[str, Any], named: tuple[object, ...]
) -> None:
    with refuses(ValueError, *named):
        replace(make(), **change)
