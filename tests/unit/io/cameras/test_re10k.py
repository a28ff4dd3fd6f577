"""``.torch`` chunks: cameras and photos of one scene among several."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene, turned
from messages import names, refuses
from re10k_chunks import entry, rows_of, save, torch

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.photo_files import resize_and_crop
from gsmerge.scene.files import find_scene_files
from gsmerge.scene.read import load_scene

SMOOTH = smooth_scene(48, 36)


def test_the_scene_is_picked_by_the_name_of_the_ply(tmp_path: Path) -> None:
    other = replace(SMOOTH, c2w=SMOOTH.c2w[::-1], images=SMOOTH.images[::-1])
    save(tmp_path, entry(other, "b"), entry(SMOOTH, "a"))
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH), cameras=False, name="a.ply")
    files = find_scene_files(tmp_path)
    assert files.cameras == files.images == tmp_path / "000000.torch"
    loaded = load_scene(tmp_path)
    scene = loaded.pixel_scene()
    assert scene.pixels.shown.all()
    assert loaded.cameras.source == "re10k chunk"
    assert np.allclose(scene.cameras.Ks, SMOOTH.K, atol=1e-4)
    assert np.allclose(scene.cameras.viewmats, SMOOTH.w2c, atol=1e-6)
    assert np.abs(scene.images * 255 - SMOOTH.images).mean() < 2
    (tmp_path / "a.ply").rename(tmp_path / "c.ply")
    with refuses(SceneError, "000000.torch", "'c'", 2, "(b, a, ...)"):
        load_scene(tmp_path, cameras=tmp_path / "000000.torch")


def test_the_only_scene_needs_no_name(tmp_path: Path) -> None:
    path = save(tmp_path, entry(SMOOTH, "a"))
    assert len(read_cameras(path)) == len(read_cameras(path, scene="b")) == 3
    torch.save(entry(SMOOTH, "a"), path)
    assert len(read_cameras(path)) == 3


@pytest.mark.slow
def test_photos_that_were_cropped(tmp_path: Path) -> None:
    """DepthSplat's file beside its dataset: photos are resized and cropped, and the first camera is the world."""
    tiny = smooth_scene(48, 48)
    mapping = resize_and_crop((96, 54), (48, 48))
    matrix = np.array([[mapping.scale_x, 0, -mapping.left], [0, mapping.scale_y, -mapping.top], [0, 0, 1]])
    photos = np.stack([
        cv2.warpAffine(image, np.linalg.inv(matrix)[:2], (96, 54), borderMode=cv2.BORDER_REPLICATE)
        for image in tiny.images
    ])  # fmt: skip
    whole = replace(tiny, K=np.linalg.inv(matrix) @ tiny.K, width=96, height=54, images=photos)
    inner = np.arange(3 * 48 * 48).reshape(3, 48, 48)[:, 8:-8, 8:-8].reshape(3, -1)
    rows = turned(export_rows(tiny, inner.T.reshape(-1)), tiny.w2c[0, :3, :3])
    save(tmp_path, entry(whole, "scene"))
    loaded = load_scene(save_export(tmp_path, tiny, rows, cameras=False))
    assert loaded.alignment.worst_px < 0.5
    assert np.allclose(loaded.scene.cameras.Ks, tiny.K, atol=1e-3)
    assert [d.name for d in loaded.exporters] == ["depthsplat"]


@pytest.mark.slow
def test_some_views_of_many(tmp_path: Path) -> None:
    """A chunk holds the whole video; the file holds two of its views."""
    poses = np.tile(SMOOTH.c2w[1], (8, 1, 1))
    poses[:, 0, 3] += 3 + np.arange(8)
    poses[2], poses[6] = SMOOTH.c2w[0], SMOOTH.c2w[2]
    images = np.tile(SMOOTH.images[1], (8, 1, 1, 1))
    images[2], images[6] = SMOOTH.images[0], SMOOTH.images[2]
    save(tmp_path, entry(replace(SMOOTH, c2w=poses, images=images, names=("",) * 8), "scene"))
    rows = export_rows(SMOOTH, np.arange(3 * 36 * 48).reshape(3, -1)[[0, 2]].reshape(-1))
    loaded = load_scene(save_export(tmp_path, SMOOTH, rows, cameras=False))
    assert loaded.scene.names == ("view 2", "view 6")
    assert "2 of 8 views are in the file" in loaded.notes


def test_without_photos(tmp_path: Path) -> None:
    for images in ([], None):
        save(tmp_path, entry(SMOOTH, "a") | {"images": images})
        actual = read_cameras(tmp_path / "000000.torch")
        assert len(actual.images) == 0
        assert np.allclose(actual.Ks[:, :2, :2], (SMOOTH.K / np.array([[48], [36], [1.0]]))[:2, :2])
    SMOOTH.save(tmp_path, cameras=False)
    (tmp_path / "images").rename(tmp_path / "photos")
    assert load_scene(tmp_path, images=tmp_path / "photos").pixel_scene().pixels.shown.all()


def test_tensors_that_want_gradients(tmp_path: Path) -> None:
    given = entry(SMOOTH, "a")
    expected = read_cameras(save(tmp_path, given)).viewmats
    actual = read_cameras(save(tmp_path, given | {"cameras": rows_of(SMOOTH).requires_grad_()}))
    assert np.array_equal(actual.viewmats, expected)


def test_other_values_beside_change_nothing(tmp_path: Path) -> None:
    others = {
        "plain": [None, True, -1, 2**40, 1.5, (), {"a": {}}, OrderedDict(b=1)],
        "tensors": [
            torch.zeros(2, 3, dtype=dtype) for dtype in (torch.float16, torch.complex64, torch.int8, torch.bool)
        ],
        "model": OrderedDict(weight=torch.nn.Parameter(torch.zeros(3))),
    }
    expected = read_cameras(save(tmp_path, entry(SMOOTH, "a"))).viewmats
    scene = others | entry(SMOOTH, "a")
    assert np.array_equal(read_cameras(save(tmp_path, scene | {"images": tuple(scene["images"])})).viewmats, expected)


@pytest.mark.parametrize(
    "store",
    [lambda rows: rows.T.contiguous().T, lambda rows: torch.cat([rows, rows], 1)[:, :18], torch.Tensor.double],
    ids=["by columns", "part of a tensor", "float64"],
)
def test_tensors_of_any_order(tmp_path: Path, store: Callable[[torch.Tensor], torch.Tensor]) -> None:
    expected = read_cameras(save(tmp_path, entry(SMOOTH, "a"))).viewmats
    actual = read_cameras(save(tmp_path, entry(SMOOTH, "a") | {"cameras": store(rows_of(SMOOTH))}))
    assert np.array_equal(actual.viewmats, expected)


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("key", ["cameras", "images", "url"])
def test_objects_are_refused_and_do_not_run(tmp_path: Path, key: str) -> None:
    path = save(tmp_path, entry(SMOOTH, "a") | {key: Payload(tmp_path / "made")})
    with refuses(SceneError, path, "damaged", "objects"):
        read_cameras(path)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_damaged_chunks_are_refused(tmp_path: Path, share: float) -> None:
    path = save(tmp_path, entry(SMOOTH, "a"))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with refuses(SceneError, path, "damaged"):
        read_cameras(path)


@pytest.mark.parametrize("value", [[], [1, 2], 5, {"a": 1}, torch.zeros(3)], ids=str)
def test_chunks_without_scenes_are_refused(tmp_path: Path, value: object) -> None:
    torch.save(value, tmp_path / "a.torch")
    with refuses(SceneError, tmp_path / "a.torch", "list of scenes"):
        read_cameras(tmp_path / "a.torch")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"cameras": None}, "[v,18]"), ({"cameras": torch.zeros(3, 17)}, "[3, 17]"),
        ({"cameras": torch.zeros(3, 18, dtype=torch.int32)}, "torch.int32"), ({"cameras": torch.zeros(0, 18)}, 0),
        ({"cameras": torch.zeros(1, 18).expand(2**40, 18)}, 2**40), ({"cameras": torch.zeros(3, 18)}, "orthonormal"),
        ({"images": [torch.zeros(9, dtype=torch.uint8)]}, 1), ({"images": [torch.zeros(9)] * 3}, "uint8"),
        ({"images": [torch.zeros(9, dtype=torch.uint8)] * 3}, "decoded"), ({"images": "abc"}, "str"),
    ],
    ids=str,
)  # fmt: skip
def test_scenes_of_another_form_are_refused(tmp_path: Path, change: dict[str, object], said: object) -> None:
    path = save(tmp_path, entry(SMOOTH, "a") | change)
    with pytest.raises(SceneError, match=path.name) as error:
        read_cameras(path)
    assert names(str(error.value), said), error.value
