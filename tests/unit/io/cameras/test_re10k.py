"""``.torch`` chunks: cameras and photos of one scene among several."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import names, refuses
from re10k_chunks import entry, rows_of, save, torch

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.scene_files import find_scene_files
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
