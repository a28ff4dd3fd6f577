"""Gaussians in memory: the same kind out as in, and conventions that are named when they are wrong."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from messages import refuses
from scenes import FIELDS, arc, make_scene, move, room

from gsmerge import CompactResult, Gaussians, Scene, SceneError, compact, compact_tensors
from gsmerge.geometry import sh0_to_rgb

FAST: dict[str, Any] = {"effort": "draft", "superpixels": "10%", "fit": "none"}
SHAPE = (3, 36, 48)
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Turned, so that no rotation is about an axis of the world."""
    turn, _ = cv2.Rodrigues(np.array([0.4, -0.7, 0.5]))
    return move(make_scene(room(), arc(3)), turn, 1.0, np.array([0.3, -0.2, 0.1]))


def tensors_of(scene: Scene, **changes: Any) -> dict[str, Any]:
    """What ``compact_tensors`` takes, as arrays, some of it changed or left out (None)."""
    given = {name: getattr(scene.gaussians, name) for name in FIELDS if name != "shN"}
    given |= {"images": scene.images, "viewmats": scene.cameras.viewmats, "Ks": scene.cameras.Ks}
    return {name: value for name, value in (given | changes).items() if value is not None}


def changed(scene: Scene, name: str, change: Change) -> dict[str, Any]:
    given = tensors_of(scene)
    return given | {name: change(np.array(given[name]))}


def same(small: CompactResult, gaussians: Gaussians) -> bool:
    return all(np.array_equal(np.asarray(getattr(small.gaussians, name)), getattr(gaussians, name)) for name in FIELDS)


def test_arrays_give_what_compact_gives(scene: Scene) -> None:
    small, result = compact_tensors(**tensors_of(scene), **FAST), compact(scene, **FAST)
    assert same(small, result.gaussians)
    assert isinstance(small.gaussians.means, np.ndarray)
    assert small.report.psnr_after == result.report.psnr_after
    assert len(small.gaussians) == small.report.num_output < 0.2 * len(scene.gaussians)


def test_tensors_give_tensors(scene: Scene) -> None:
    """With further axes in front, gradients, 3 x 4 poses and another type."""
    given: dict[str, Any] = {name: torch.tensor(value) for name, value in tensors_of(scene).items()}
    given["means"] = given["means"].reshape(*SHAPE, 3).requires_grad_()
    given["scales"], given["opacities"] = given["scales"][None], given["opacities"][None, :, None].double()
    given["viewmats"] = given["viewmats"][:, :3]
    small = compact_tensors(**given, **FAST)
    assert all(isinstance(getattr(small.gaussians, name), torch.Tensor) for name in FIELDS)
    assert small.gaussians.device == given["means"].device
    assert not small.gaussians.means.requires_grad
    assert same(small, compact(scene, **FAST).gaussians)


def test_bfloat16_is_read(scene: Scene) -> None:
    opacities = torch.tensor(scene.gaussians.opacities).bfloat16()
    small = compact_tensors(**tensors_of(scene, opacities=opacities), **FAST)
    assert small.gaussians.opacities.dtype == np.float32


def test_colors_stand_for_harmonics(scene: Scene) -> None:
    colors = sh0_to_rgb(scene.gaussians.sh0[:, 0])
    small = compact_tensors(**tensors_of(scene, sh0=None, colors=colors), **FAST)
    expected = compact_tensors(**tensors_of(scene), **FAST).gaussians.sh0
    np.testing.assert_allclose(small.gaussians.sh0, expected, atol=1e-5)


def test_input_is_left_alone_and_odd_rows_are_set_aside(scene: Scene) -> None:
    given = changed(scene, "scales", lambda s: np.where(np.arange(len(s))[:, None] == 7, np.nan, s))
    before = {name: np.array(value) for name, value in given.items()}
    small = compact_tensors(**given, **FAST)
    assert "1 row(s) with NaN or inf, set aside" in small.report.notes
    assert all(np.array_equal(before[name], given[name], equal_nan=True) for name in before)
    assert np.isfinite(small.gaussians.means).all()


def test_gaussians_of_no_pixels(scene: Scene) -> None:
    rows = np.random.default_rng(0).permutation(len(scene.gaussians))[:-9]
    given = tensors_of(scene, **{name: getattr(scene.gaussians, name)[rows] for name in FIELDS})
    small = compact_tensors(**given, order="none", **FAST)
    assert 0 < len(small.gaussians) < len(rows)
    bare = {name: given[name] for name in FIELDS}
    assert len(compact_tensors(**bare, order="none", **FAST).cameras) == 0
    with refuses(SceneError, "viewmats", "camera-to-world", "inverse"):
        compact_tensors(**given | {"viewmats": np.linalg.inv(given["viewmats"])}, order="none", **FAST)


def invert(viewmats: np.ndarray) -> np.ndarray:
    return np.linalg.inv(viewmats)


def flip(viewmats: np.ndarray) -> np.ndarray:
    return np.diag([1.0, -1, -1, 1]) @ viewmats


def doubled(Ks: np.ndarray) -> np.ndarray:
    return Ks * np.array([2.0, 2, 1])[:, None]


WRONG: list[tuple[str, Change, str]] = [
    ("scales", np.log, r"negative ones in 100 % of rows; they look like log scales: pass scales.exp\(\)"),
    ("opacities", lambda o: np.log(o / (1 - o)), r"in \[0, 1\], found .*logits: pass torch.sigmoid\(opacities\)"),
    ("quats", lambda q: 3 * q, "unit quaternions wxyz, found 100 % with lengths of 3 to 3; pass .*normalize"),
    ("quats", lambda q: q[:, [1, 2, 3, 0]], r"stored with w last.*; pass quats\[:, \[3, 0, 1, 2\]\]"),
    ("quats", lambda q: q[:, :3], r"expected shape \[n, 4\], found \[5184, 3\]"),
    ("viewmats", invert, r"read as camera-to-world matrices with OpenCV axes; pass their inverse"),
    ("viewmats", flip, "read as world-to-camera matrices with OpenGL axes; negate the second and the third row"),
    ("viewmats", lambda m: invert(flip(m)), "camera-to-world matrices with OpenGL axes; negate .* column"),
    ("viewmats", lambda m: m.transpose(0, 2, 1), "last row, found another; if they are transposed"),
    ("viewmats", lambda m: m[:2], r"expected shape \[3, 3, 4\] or \[3, 4, 4\], found \[2, 4, 4\]"),
    ("Ks", lambda K: K / np.array([48, 36, 1])[:, None], "in pixels, found a focal length of 1; they look divided"),
    ("Ks", doubled, "of 48 x 36 pixels, found those of another size; multiply their first row by 0.5"),
    ("images", lambda i: 255 * i, "found 0 to 2.*look like 0 to 255: pass images / 255"),
    ("images", lambda i: (255 * i).astype(np.uint8), "they look like 0 to 255: pass images / 255"),
    ("images", lambda i: 2 * i - 1, r"they look like -1 to 1: pass \(images \+ 1\) / 2"),
    ("images", lambda i: i.transpose(0, 3, 1, 2), r"channels come first: pass images.permute\(0, 2, 3, 1\)"),
    ("sh0", lambda c: np.repeat(c, 4, 1), r"expected 5184 rows, .*found 20736; pass sh0=sh\[:, :1\] and shN"),
    ("means", lambda m: m.reshape(36, 48, 3, 3).transpose(2, 0, 1, 3), "fit"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "words"), WRONG, ids=[f"{name}-{i}" for i, (name, *_) in enumerate(WRONG)])
def test_a_wrong_convention_is_named(scene: Scene, name: str, change: Change, words: str) -> None:
    with pytest.raises(SceneError) as error:
        compact_tensors(**changed(scene, name, change), **FAST)
    assert str(error.value).startswith(f"{name}: ")
    assert re.search(words, str(error.value)), str(error.value)
    assert "\n" not in str(error.value)


def test_colors_of_bytes_and_channel_major_harmonics_are_named(scene: Scene) -> None:
    colors = 255 * sh0_to_rgb(scene.gaussians.sh0[:, 0]).clip(0, 1)
    with refuses(SceneError, "colors", "colors / 255"):
        compact_tensors(**tensors_of(scene, sh0=None, colors=colors), **FAST)
    with pytest.raises(SceneError, match=r"^shN: .*transpose"):
        compact_tensors(**tensors_of(scene, shN=np.zeros((len(colors), 3, 8))), **FAST)
    for more in ({"colors": colors}, {"sh0": None}):
        with refuses(SceneError, "sh0", "colors"):
            compact_tensors(**tensors_of(scene, **more), **FAST)


def test_wrong_sizes_are_named(scene: Scene) -> None:
    with refuses(SceneError, "means", 5040, 5184):
        compact_tensors(**tensors_of(scene, images=None), shape=(3, 35, 48), **FAST)
    with refuses(SceneError, "shape", "neither"):
        compact_tensors(**tensors_of(scene, images=None), **FAST)
    with refuses(SceneError, "images", [3, 35, 48, 3], [3, 36, 48, 3]):
        compact_tensors(**tensors_of(scene), shape=(3, 35, 48), **FAST)
    with refuses(SceneError, "shape", [36, 48]):
        compact_tensors(**tensors_of(scene), shape=(36, 48), **FAST)
    with refuses(SceneError, "viewmats", "none"):
        compact_tensors(**tensors_of(scene, viewmats=None, Ks=None), order="none", **FAST)
    with refuses(SceneError, "names", 3, 1):
        compact_tensors(**tensors_of(scene), names=["a"], **FAST)
    with refuses(SceneError, "quats", "str"):
        compact_tensors(**tensors_of(scene, quats="wxyz"), **FAST)
    with refuses(SceneError, "means", "5,184 rows"):
        compact_tensors(**changed(scene, "scales", lambda s: s * np.nan), **FAST)
    with refuses(ValueError, "order", "'layers'"):
        compact_tensors(**tensors_of(scene), order="layers", **FAST)


def test_rotations_may_be_left_unchecked(scene: Scene) -> None:
    given = changed(scene, "quats", lambda q: q[:, [1, 2, 3, 0]])
    notes = compact_tensors(**given, check_rotations=False, **FAST).report.notes
    signed = changed(scene, "quats", lambda q: (q * np.where(q[:, :1] < 0, -1, 1))[:, [1, 2, 3, 0]])
    warned = compact_tensors(**signed, check_rotations=False, **FAST).report.notes
    assert [any("if w comes last" in note for note in some) for some in (notes, warned)] == [
        bool((scene.gaussians.quats[:, 0] >= 0).all()), True
    ]  # fmt: skip


def test_w_first_with_a_last_column_that_is_never_negative_gets_no_note(scene: Scene) -> None:
    """As Depth Anything 3 has it; without pixels it takes the caller's word."""
    signed = changed(scene, "quats", lambda q: q * np.where(q[:, 3:] < 0, -1, 1))
    assert signed["quats"][:, 0].min() < 0
    given = [(True, {}), (False, {}), (False, {"order": "none"}), (True, {"order": "none"})]
    notes = [compact_tensors(**signed, check_rotations=check, **more, **FAST).report.notes for check, more in given]
    assert [any("if w comes last" in note for note in some) for some in notes] == [False, False, False, True]


def test_centres_at_corners_get_a_note(scene: Scene) -> None:
    shifted = changed(scene, "Ks", lambda K: K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    notes = compact_tensors(**shifted, **FAST).report.notes
    assert any("add 0.5 to cx, cy" in note for note in notes)
    assert not any("0.5" in note for note in compact_tensors(**tensors_of(scene), **FAST).report.notes)


def test_levels_are_tensors_as_well(scene: Scene) -> None:
    given = {name: torch.tensor(value) for name, value in tensors_of(scene).items()}
    small = compact_tensors(**given, **FAST, levels=2)
    assert [isinstance(one.gaussians.means, torch.Tensor) for one in small.coarser] == [True]


def test_cameras_stay_where_they_fit(scene: Scene) -> None:
    """The result has them, so that it can be written with :func:`gsmerge.write_gaussians` and shown from them."""
    small = compact_tensors(**tensors_of(scene), names=[f"photo {i}" for i in range(3)], **FAST)
    np.testing.assert_array_equal(small.cameras.viewmats, scene.cameras.viewmats)
    np.testing.assert_array_equal(small.cameras.Ks, scene.cameras.Ks)


def test_a_path_in_place_of_a_scene(made_scene: Path) -> None:
    from gsmerge import read_scene

    result = compact(made_scene / "scene.ply", **FAST)
    assert len(result.gaussians) == len(compact(read_scene(made_scene), **FAST).gaussians)
    assert len(compact(str(made_scene), **FAST).gaussians) == len(result.gaussians)
    with pytest.raises(SceneError, match=r"nowhere\.ply"):
        compact("nowhere.ply")
