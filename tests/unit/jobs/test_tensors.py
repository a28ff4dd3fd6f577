"""Gaussians in memory keep their kind of array, and a wrong convention is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from messages import noted, refuses
from scenes import FIELDS, arc, make_scene, move, room

from gsmerge import CompactResult, Gaussians, Scene, SceneError, compact, compact_tensors, evaluate, read_scene, render
from gsmerge.method.geometry.transforms import sh0_to_rgb
from gsmerge.method.kernels import elementary
from gsmerge.reading.input import check_scene

FAST: dict[str, Any] = {"effort": "draft", "superpixels": "10%", "fit": "none"}
SHAPE = (3, 36, 48)
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Make a room that is turned, so that no rotation is about an axis of the world."""
    turn, _ = cv2.Rodrigues(np.array([0.4, -0.7, 0.5]))
    return move(make_scene(room(), arc(3)), turn, 1.0, np.array([0.3, -0.2, 0.1]))


def tensors_of(scene: Scene, **changes: Any) -> dict[str, Any]:
    """Return what ``compact_tensors`` takes, as arrays, some of it changed or left out (None)."""
    given = {name: getattr(scene.gaussians, name) for name in FIELDS if name != "shN"}
    given |= {"images": scene.images, "viewmats": scene.cameras.viewmats, "Ks": scene.cameras.Ks}
    return {name: value for name, value in (given | changes).items() if value is not None}


def changed(scene: Scene, name: str, change: Change) -> dict[str, Any]:
    given = tensors_of(scene)
    return given | {name: change(np.array(given[name]))}


def has_values_of(small: CompactResult, gaussians: Gaussians) -> bool:
    return all(np.array_equal(np.asarray(getattr(small.gaussians, name)), getattr(gaussians, name)) for name in FIELDS)


def test_compact_tensors_of_arrays_gives_what_compact_gives(scene: Scene) -> None:
    small, result = compact_tensors(**tensors_of(scene), **FAST), compact(scene, **FAST)
    assert has_values_of(small, result.gaussians)
    assert isinstance(small.gaussians.means, np.ndarray)
    assert small.report.psnr_after == result.report.psnr_after
    assert len(small.gaussians) == small.report.num_output < 0.2 * len(scene.gaussians)


def test_compact_tensors_of_tensors_gives_tensors(scene: Scene, torch: Any) -> None:
    """With further axes in front, gradients, 3 x 4 poses and another type."""
    given: dict[str, Any] = {name: torch.tensor(value) for name, value in tensors_of(scene).items()}
    given["means"] = given["means"].reshape(*SHAPE, 3).requires_grad_()
    given["scales"], given["opacities"] = given["scales"][None], given["opacities"][None, :, None].double()
    given["viewmats"] = given["viewmats"][:, :3]
    small = compact_tensors(**given, **FAST, levels=2)
    for each in (small, *small.coarser):
        assert all(isinstance(getattr(each.gaussians, name), torch.Tensor) for name in FIELDS)
    assert len(small.coarser) == 1
    assert small.gaussians.device == given["means"].device
    assert not small.gaussians.means.requires_grad
    assert has_values_of(small, compact(scene, **FAST).gaussians)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_means_have_the_number_type_that_was_given(kind: Any, scene: Scene) -> None:
    small = compact_tensors(**tensors_of(scene, means=np.asarray(scene.gaussians.means, kind)), **FAST, levels=2)
    assert [each.gaussians.means.dtype for each in (small, *small.coarser)] == [kind, kind]
    assert small.gaussians.scales.dtype == np.float32


def test_bfloat16_is_read_as_float32(scene: Scene, torch: Any) -> None:
    opacities = torch.tensor(scene.gaussians.opacities).bfloat16()
    small = compact_tensors(**tensors_of(scene, opacities=opacities), **FAST)
    assert small.gaussians.opacities.dtype == np.float32


@pytest.mark.parametrize("change", [
    np.asfortranarray, lambda values: np.repeat(values, 2, 0)[::2], lambda values: values.astype(">f8"),
    lambda values: values.astype(np.longdouble),
], ids=["column by column", "with gaps", "big-endian", "long double"])  # fmt: skip
def test_the_layout_of_arrays_does_not_change_the_result(scene: Scene, change: Change) -> None:
    plain = {name: np.array(value, np.float32) for name, value in tensors_of(scene).items()}
    given = {name: change(value) for name, value in plain.items()}
    assert has_values_of(compact_tensors(**given, **FAST), compact_tensors(**plain, **FAST).gaussians)


WITHOUT_NUMBERS: dict[str, Callable[[Any, Any], Any]] = {  # by a word of their description
    "meta": lambda _, values: values.to("meta"),
    "sparse_coo": lambda _, values: values.to_sparse(),
    "complex": lambda _, values: values + 1j,
    "qint8": lambda torch, values: torch.quantize_per_tensor(values.float(), 0.1, 0, torch.qint8),
    "strided": lambda torch, values: torch.nested.nested_tensor([values]),
    "object": lambda _, values: values.numpy().astype(object),
}


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
@pytest.mark.filterwarnings("ignore:torch.quantize")
@pytest.mark.parametrize("name", ["means", "opacities", "viewmats", "images"])
@pytest.mark.parametrize("kind", WITHOUT_NUMBERS)
def test_tensors_that_are_not_dense_numbers_are_refused(scene: Scene, torch: Any, kind: str, name: str) -> None:
    given = tensors_of(scene)
    wrong = WITHOUT_NUMBERS[kind](torch, torch.tensor(given[name]))
    with pytest.raises(SceneError, match=rf"{name}: expected an array or a dense tensor of numbers, found .*{kind}.*"):
        compact_tensors(**given | {name: wrong}, **FAST)


def test_tensors_without_values_are_refused_by_render(scene: Scene) -> None:
    with refuses(SceneError, "tensor", "on meta"):
        render(scene.gaussians.to("meta"), scene.cameras)


def test_colors_may_be_given_in_place_of_harmonics(scene: Scene) -> None:
    colors = sh0_to_rgb(scene.gaussians.sh0[:, 0])
    small = compact_tensors(**tensors_of(scene, sh0=None, colors=colors), **FAST)
    expected = compact_tensors(**tensors_of(scene), **FAST).gaussians.sh0
    np.testing.assert_allclose(small.gaussians.sh0, expected, atol=1e-5)


def test_rows_with_nan_are_set_aside_without_a_change_of_the_input(scene: Scene) -> None:
    given = changed(scene, "scales", lambda s: np.where(np.arange(len(s))[:, None] == 7, np.nan, s))
    before = {name: np.array(value) for name, value in given.items()}
    small = compact_tensors(**given, **FAST)
    assert noted(small.report.notes, "1 row with", "NaN")
    assert all(np.array_equal(before[name], given[name], equal_nan=True) for name in before)
    assert np.isfinite(small.gaussians.means).all()


@pytest.mark.slow
def test_gaussians_without_pixels_are_compacted(scene: Scene) -> None:
    rows = np.random.default_rng(0).permutation(len(scene.gaussians))[:-9]
    given = tensors_of(scene, **{name: getattr(scene.gaussians, name)[rows] for name in FIELDS})
    small = compact_tensors(**given, order="none", **FAST)
    assert 0 < len(small.gaussians) < len(rows)
    bare = {name: given[name] for name in FIELDS}
    assert len(compact_tensors(**bare, order="none", **FAST).cameras) == 0
    with refuses(SceneError, "viewmats", "camera-to-world", "inverse"):
        compact_tensors(**given | {"viewmats": np.linalg.inv(given["viewmats"])}, order="none", **FAST)


def flip(viewmats: np.ndarray) -> np.ndarray:
    return np.diag([1.0, -1, -1, 1]) @ viewmats


WRONG: list[tuple[str, Change, list[object]]] = [
    ("scales", elementary.log, ["100 %", "scales.exp()"]),
    ("opacities", lambda o: elementary.log(o / (1 - o)), ["[0, 1]", "torch.sigmoid(opacities)"]),
    ("quats", lambda q: 3 * q, ["wxyz", "100 %", "3 to 3"]),
    ("quats", lambda q: q[:, :3], ["[n, 4]", [5184, 3]]),
    ("viewmats", np.linalg.inv, ["camera-to-world", "OpenCV", "inverse"]),
    ("viewmats", flip, ["world-to-camera", "OpenGL", "row"]),
    ("viewmats", lambda m: np.linalg.inv(flip(m)), ["camera-to-world", "OpenGL", "column"]),
    ("viewmats", lambda m: m.transpose(0, 2, 1), ["last row", "transposed"]),
    ("viewmats", lambda m: m[:2], ["[3, 3, 4]", "[3, 4, 4]", [2, 4, 4]]),
    ("Ks", lambda K: K / np.array([48, 36, 1])[:, None], ["pixels", 1, "divided"]),
    ("Ks", lambda Ks: Ks * np.array([2.0, 2, 1])[:, None], ["48 x 36", "row by 0.5"]),
    ("images", lambda i: 255 * i, ["0 to 255", "images / 255"]),
    ("images", lambda i: (255 * i).astype(np.uint8), ["0 to 255", "images / 255"]),
    ("images", lambda i: 2 * i - 1, ["-1 to 1", "(images + 1) / 2"]),
    ("images", lambda i: i.transpose(0, 3, 1, 2), ["channels", "images.permute(0, 2, 3, 1)"]),
    ("sh0", lambda c: np.repeat(c, 4, 1), [5184, 20736, "sh0=sh[:, :1]", "shN"]),
    ("means", lambda m: m.reshape(36, 48, 3, 3).transpose(2, 0, 1, 3), ["1.5 px"]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "found"), WRONG, ids=[f"{name}-{i}" for i, (name, *_) in enumerate(WRONG)])
def test_a_wrong_convention_is_named(scene: Scene, name: str, change: Change, found: list[object]) -> None:
    with refuses(SceneError, name, *found):
        compact_tensors(**changed(scene, name, change), **FAST)


SAME_RULES: list[tuple[str, Change]] = [
    ("scales", elementary.log), ("opacities", lambda o: 8 * o),
    ("means", lambda m: m.astype(complex)), ("means", lambda m: m.astype(object)), ("sh0", lambda c: c.astype(str)),
    ("viewmats", lambda m: m * np.nan), ("viewmats", lambda m: m.transpose(0, 2, 1)), ("Ks", lambda K: -K),
    ("images", lambda i: i.astype(complex)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change"), SAME_RULES)
def test_scenes_in_memory_are_checked_as_tensors_are(scene: Scene, name: str, change: Change) -> None:
    """For compact and evaluate alike; single values that are not finite are set aside."""
    given = changed(scene, name, change)
    parts = {"gaussians": scene.gaussians, "cameras": scene.cameras}
    owners = {owner: replace(part, **{name: given[name]}) for owner, part in parts.items() if hasattr(part, name)}
    wrong = replace(scene, **owners or {name: given[name]})
    calls = (lambda: compact_tensors(**given, **FAST), lambda: compact(wrong, **FAST), lambda: evaluate(wrong, {}))
    messages = set()
    for call in calls:
        with refuses(SceneError, name) as refused:
            call()
        messages.add(str(refused.value))
    assert len(messages) == 1


def test_rows_that_are_not_finite_are_not_taken_for_another_convention(scene: Scene) -> None:
    columns = {name: np.array(getattr(scene.gaussians, name)) for name in ("scales", "opacities")}
    columns["scales"][3], columns["opacities"][4:6] = -np.inf, (np.inf, np.nan)
    check_scene(replace(scene, gaussians=replace(scene.gaussians, **columns)))
    check_scene(replace(scene, gaussians=scene.gaussians[:0], pixels=None))


def test_colors_of_bytes_and_channel_major_harmonics_are_named(scene: Scene) -> None:
    colors = 255 * sh0_to_rgb(scene.gaussians.sh0[:, 0]).clip(0, 1)
    with refuses(SceneError, "colors", "colors / 255"):
        compact_tensors(**tensors_of(scene, sh0=None, colors=colors), **FAST)
    with pytest.raises(SceneError, match=r"^shN: .*transpose"):
        compact_tensors(**tensors_of(scene, shN=np.zeros((len(colors), 3, 8))), **FAST)
    for more in ({"colors": colors}, {"sh0": None}):
        with refuses(SceneError, "sh0", "colors"):
            compact_tensors(**tensors_of(scene, **more), **FAST)


def test_arrays_of_wrong_sizes_are_named(scene: Scene) -> None:
    for changes, place, *found in (
        ({"images": None, "shape": (3, 35, 48)}, "means", 5040, 5184), ({"images": None}, "shape", "neither"),
        ({"shape": (3, 35, 48)}, "images", [3, 35, 48, 3], [3, 36, 48, 3]), ({"shape": (36, 48)}, "shape", [36, 48]),
        ({"viewmats": None, "Ks": None, "order": "none"}, "viewmats", "none"), ({"names": ["a"]}, "names", 3, 1),
        ({"quats": "wxyz"}, "quats", "str"), ({"scales": scene.gaussians.scales * np.nan}, "means", "5,184 rows"),
    ):  # fmt: skip
        with refuses(SceneError, place, *found):
            compact_tensors(**tensors_of(scene) | changes, **FAST)
    with refuses(ValueError, "order", "'layers'"):
        compact_tensors(**tensors_of(scene), order="layers", **FAST)


def test_quaternions_whose_last_column_is_never_negative_get_a_note(scene: Scene) -> None:
    last = changed(scene, "quats", lambda q: (q * np.where(q[:, :1] < 0, -1, 1))[:, [1, 2, 3, 0]])
    notes = [compact_tensors(**given, **FAST).report.notes for given in (last, tensors_of(scene))]
    assert [noted(some, "w", "last") for some in notes] == [True, False]


def test_cameras_that_fit_stay_as_they_were_given(scene: Scene) -> None:
    """The result has them, so that it can be written with :func:`gsmerge.write_gaussians` and shown from them."""
    small = compact_tensors(**tensors_of(scene), names=[f"photo {i}" for i in range(3)], **FAST)
    np.testing.assert_array_equal(small.cameras.viewmats, scene.cameras.viewmats)
    np.testing.assert_array_equal(small.cameras.Ks, scene.cameras.Ks)


def test_compact_takes_a_path_in_place_of_a_scene(tiny_folder: Path) -> None:
    result = compact(tiny_folder / "scene.ply", **FAST)
    assert len(result.gaussians) == len(compact(read_scene(tiny_folder), **FAST).gaussians)
    assert len(compact(str(tiny_folder), **FAST).gaussians) == len(result.gaussians)
    with pytest.raises(SceneError, match=r"nowhere\.ply"):
        compact("nowhere.ply")
