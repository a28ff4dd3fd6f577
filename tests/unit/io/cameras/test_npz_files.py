"""Cameras and arrays are read from ``.npz``."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from messages import refuses
from tiny_scene import Tiny, assert_same, write_npz

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.cameras.npz_files import array_names, read_arrays


def test_every_form_of_cameras_in_an_npz_is_read(tmp_path: Path, tiny: Tiny) -> None:
    write_npz(tmp_path / "a.npz", tiny, extrinsics=tiny.w2c, image=None)
    actual = read_cameras(tmp_path / "a.npz")
    assert_same(actual, tiny, atol=1e-6)
    assert len(actual.images) == 0
    centred = np.tile(np.array([[22.0, 0, 10], [0, 22, 7], [0, 0, 1]]), (3, 1, 1))
    write_npz(tmp_path / "b.npz", tiny, intrinsics=centred, image=None, depth=None)
    assert_same(read_cameras(tmp_path / "b.npz"), tiny, K=centred, atol=1e-6)
    write_npz(tmp_path / "c.npz", tiny, image=(tiny.images / 255).astype(np.float32).transpose(0, 3, 1, 2))
    assert np.array_equal(read_cameras(tmp_path / "c.npz").images, tiny.images)


def test_npz_intrinsics_of_another_size_are_scaled(tmp_path: Path, tiny: Tiny) -> None:
    centred = np.array([[22.0, 0, 10], [0, 21, 7], [0, 0, 1]])
    original = centred * np.array([[8.1], [8.0], [1]])
    write_npz(tmp_path / "a.npz", tiny, intrinsics=np.tile(original, (3, 1, 1)))
    assert_same(read_cameras(tmp_path / "a.npz"), tiny, K=centred, atol=1e-6)
    normalised = centred / np.array([[20], [14], [1]])
    write_npz(tmp_path / "b.npz", tiny, intrinsics=np.tile(normalised, (3, 1, 1)))
    assert_same(read_cameras(tmp_path / "b.npz"), tiny, K=centred, atol=1e-6)


def test_npz_intrinsics_of_a_colmap_export_of_the_same_call_are_scaled_back(tmp_path: Path, tiny: Tiny) -> None:
    """Older versions of Depth Anything 3 scale them in place, to the photos' sizes."""
    centred = np.array([[*tiny.K[0, :2], 10], [*tiny.K[1, :2], 7], [0, 0, 1]])
    scaled = np.tile(centred * np.array([[1.5], [1.52], [1]]), (3, 1, 1)).astype(np.float32)
    write_npz(tmp_path / "exports/npz/results.npz", tiny, intrinsics=scaled)
    assert_same(read_cameras(tmp_path / "exports/npz"), tiny, K=centred, atol=1e-2)


def test_the_message_on_a_damaged_npz_is_the_same_every_time(tmp_path: Path) -> None:
    """NumPy's message has the address of an object, which differs in every process."""
    head = b"{'descr': name, 'fortran_order': False, 'shape': (3,)}\n"
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("extrinsics.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(24))
    with refuses(SceneError, "a.npz", "damaged", "malformed node") as refusal:
        read_cameras(tmp_path / "a.npz")
    assert "0x" not in str(refusal.value)


def test_arrays_are_read_by_name(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.eye(3, 2)), "c": np.array("text")}
    np.savez_compressed(tmp_path / "a.npz", **arrays, d=np.array([{}]))
    assert array_names(tmp_path / "a.npz") == {"a", "b", "c", "d"}
    actual = read_arrays(tmp_path / "a.npz", ("a", "b", "c", "e"))
    assert actual.keys() == {"a", "b", "c"}
    assert all(np.array_equal(actual[name], arrays[name]) for name in actual)
    with refuses(SceneError, "a.npz: d.npy", "objects"):
        read_arrays(tmp_path / "a.npz", ("d",))
    assert array_names(tmp_path / "none.npz") == frozenset()
