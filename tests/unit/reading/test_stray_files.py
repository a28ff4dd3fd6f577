"""Cameras, photos and masks of something else are left out, and ``none`` takes their place."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import names, noted, refuses
from sweeps import sweep
from tiny_scene import Tiny, rotation, write_colmap_binary, write_images, write_inria, write_npz, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io import write_gaussians
from gsmerge.io.image_names import CLIP_ENDS
from gsmerge.reading.read_scene import Loaded, load_scene, read_scene

SMOOTH = smooth_scene(56, 40)
ALL = np.arange(len(SMOOTH.gaussians))
SOME = np.random.default_rng(0).permutation(ALL)[:4027]
KINDS = {"grid": ALL, "voxels": SOME[np.lexsort(SMOOTH.gaussians.means[SOME].round(1).T)]}


def another() -> Tiny:
    """Return cameras and photos of another capture, of four views."""
    c2w = np.concatenate([SMOOTH.c2w, SMOOTH.c2w[:1]])
    for pose, (x, y, z) in zip(c2w, np.random.default_rng(1).uniform(-1, 1, (4, 3)), strict=True):
        pose[:3, :3], pose[:3, 3] = rotation(3 * x, 3 * y, z), (50 + x, y, 9 * z)
    images = np.random.default_rng(0).integers(0, 256, (4, 40, 56, 3), np.uint8)
    return replace(SMOOTH, c2w=c2w, images=images, names=("o/1.png", "o/2.png", "o/3.png", "o/4.png"))


def with_photos(folder: Path) -> None:
    write_transforms(folder / "transforms.json", another())
    write_images(folder / "images", another())


STRAY: dict[str, Callable[[Path], object]] = {
    "transforms.json": lambda folder: write_transforms(folder / "transforms.json", another()),
    "cameras.json": lambda folder: write_inria(folder / "cameras.json", another()),
    "images": with_photos,
    "colmap": lambda folder: write_colmap_binary(folder / "colmap", another()),
    "results.npz": lambda folder: write_npz(folder / "results.npz", another()),
    "views.npz": lambda folder: (folder / "views.npz").write_bytes(b"PK\3\4nothing"),
    "damaged": lambda folder: (folder / "transforms.json").write_text('{"frames": ['),
    "other": lambda folder: (folder / "cameras.json").write_text('{"camera": {"fov": 60}}'),
}


def save(folder: Path, kind: str, *, cameras: bool = False) -> Path:
    return save_export(folder, SMOOTH, export_rows(SMOOTH, KINDS[kind]), cameras=cameras)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Loaded]:
    """Return what each kind of file is without anything beside it."""
    folder = tmp_path_factory.mktemp("alone")
    return {kind: load_scene(save(folder / kind, kind)) for kind in KINDS}


def read_once(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Loaded:
    """Read a scene as users do -> all facts about its files; the search for its cameras takes a second."""
    seen: list[Loaded] = []

    def watched(*words: object, **named: object) -> Loaded:
        seen.append(load_scene(*words, **named))  # type: ignore[arg-type]
        return seen[-1]

    monkeypatch.setattr("gsmerge.reading.read_scene.load_scene", watched)
    scene = read_scene(folder)
    (loaded,) = seen
    assert (scene.gaussians, scene.notes) == (loaded.scene.gaussians, loaded.notes)
    return loaded


def same(actual: Loaded, alone: Loaded) -> bool:
    scenes = actual.scene, alone.scene
    means = [scene.gaussians.means for scene in scenes]
    return (
        np.array_equal(*means)
        and len({(len(scene), scene.has_own_pixels, scene.images is None) for scene in scenes}) == 1
    )


@sweep("stray", STRAY, often=2)
@pytest.mark.parametrize("kind", KINDS)
def test_what_belongs_to_something_else_is_left_out(
    tmp_path: Path, alone: dict[str, Loaded], kind: str, stray: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = save(tmp_path / "scene", kind)
    STRAY[stray](folder)
    with pytest.warns(UserWarning, match="left out"):
        actual = read_once(monkeypatch, folder)
    assert same(actual, alone[kind])
    assert actual.files.cameras is None
    assert actual.doubts[0] == actual.notes[0]  # the others follow from it
    others = list(actual.notes[1:])
    assert [note for note in others if "photos" not in note or kind == "voxels"] == list(alone[kind].notes)


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_that_are_named_are_refused(tmp_path: Path, kind: str) -> None:
    folder = save(tmp_path, kind)
    write_transforms(folder / "transforms.json", another())
    with refuses(SceneError, "scene.ply", "--cameras none"):
        load_scene(folder, cameras=folder / "transforms.json")
    write_images(folder / "images", another())
    alone = load_scene(folder, cameras="none")
    assert noted(alone.notes, folder / "images")
    assert not noted(alone.notes, "name them with --cameras")
    assert alone.files.cameras is None


def test_photos_of_something_else_beside_the_right_cameras_are_left_out(tmp_path: Path) -> None:
    folder = save(tmp_path, "grid")
    write_transforms(folder / "transforms.json", SMOOTH)
    write_images(folder / "images", another())
    actual = load_scene(folder)
    assert names(str(actual.doubts), "the photos in", folder / "images", "left out", "3 views")
    assert np.allclose(actual.scene.cameras.viewmats, SMOOTH.w2c)
    assert actual.scene.images is None
    with refuses(SceneError, "images", "3 views", "--images none"):
        load_scene(folder, images=folder / "images")


def test_photos_of_something_else_beside_a_grid_are_left_out(tmp_path: Path) -> None:
    folder = save(tmp_path, "grid")
    write_images(folder / "images", another())
    assert names(str(load_scene(folder).doubts), "the photos in", folder / "images", "left out")


def test_damaged_pictures_beside_a_grid_are_a_doubt(tmp_path: Path) -> None:
    folder = save(tmp_path, "grid")
    for number in range(3):
        (folder / f"{number}.png").write_bytes(b"\x89PNG nothing")
    assert names(str(load_scene(folder).doubts), "the photos in", folder, "0.png")


@pytest.mark.parametrize("kind", KINDS)
def test_none_leaves_out_cameras_photos_or_masks(tmp_path: Path, kind: str) -> None:
    folder = save(tmp_path, kind, cameras=True)
    write_images(folder / "masks", replace(SMOOTH, images=np.full_like(SMOOTH.images, 255)))
    assert load_scene(folder, images="none").scene.images is None
    assert len(load_scene(folder, images="none").scene) == 3
    assert load_scene(folder, masks="none").files.masks is None
    alone = load_scene(folder, cameras="none", images="none")
    assert len(alone.scene) == (3 if kind == "grid" else 0)
    assert not alone.doubts


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_called_none_has_a_path(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = save(tmp_path, kind, cameras=True)
    (folder / "none").mkdir()
    (folder / "transforms.json").rename(folder / "none" / "transforms.json")
    monkeypatch.chdir(folder)
    assert load_scene(folder, cameras=Path("none")).files.cameras == Path("none")
    assert load_scene(folder, cameras="./none").files.cameras == Path("none")


def test_found_masks_that_are_dark_or_damaged_are_left_out(tmp_path: Path) -> None:
    """Dark nearly everywhere, or damaged."""
    folder = save(tmp_path, "grid", cameras=True)
    write_images(folder / "masks", replace(SMOOTH, images=np.zeros_like(SMOOTH.images)))
    assert noted(load_scene(folder).notes, "masks are not used", "100 %")
    with refuses(SceneError, "masks", "100 %"):
        load_scene(folder, masks=folder / "masks")
    (folder / "masks" / SMOOTH.names[1]).write_bytes(b"\x89PNG nothing")
    actual = load_scene(folder)
    assert names(str(actual.doubts), "masks are left out", SMOOTH.names[1])
    assert actual.scene.images is not None


@pytest.mark.parametrize("hints", [{"order": "view-major"}, {"order": "view-fastest"}])
@pytest.mark.parametrize("cameras", [False, True])
def test_hints_on_pixels_for_rows_that_have_none_are_refused(
    cameras: bool, tmp_path: Path, hints: dict[str, str]
) -> None:
    ((name, value),) = hints.items()
    folder = save(tmp_path / str(cameras), "voxels", cameras=cameras)
    with refuses(SceneError, "scene.ply", f"--hint {name}={value}"):
        load_scene(folder, **hints)


@pytest.mark.parametrize(
    ("place", "words"), [("walk.MP4", "a film"), ("images/a.heic", "1 .heic"), ("images/b.jxl", "1 .jxl")]
)
def test_a_scene_without_photos_says_what_beside_it_is_not_read(tiny_folder: Path, place: str, words: str) -> None:
    shutil.rmtree(tiny_folder / "images")
    path = tiny_folder / place
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"\0" * 20)
    assert noted(load_scene(tiny_folder).notes, words, "cannot be read")
    assert not noted(load_scene(tiny_folder, images="none").notes, words)


def test_a_clip_is_no_film_of_the_capture(tiny_folder: Path, tiny: Tiny) -> None:
    """It is known by its end; beside a result, any film is a clip."""
    shutil.rmtree(tiny_folder / "images")
    (tiny_folder / "a.mp4").write_bytes(b"\0" * 20 + CLIP_ENDS[".mp4"])
    assert not noted(load_scene(tiny_folder).notes, "film")
    (tiny_folder / "b.webm").write_bytes(b"\0" * 20)
    assert noted(load_scene(tiny_folder).notes, "film")
    write_gaussians(small := tiny_folder / "small.spz", tiny.gaussians)
    write_inria(tiny_folder / "small.cameras.json", tiny)
    assert not noted(load_scene(small).notes, "film")


@pytest.mark.parametrize(("share", "is_doubt"), [(0.005, False), (0.05, True)])
def test_rows_far_from_their_pixels_are_doubted(tmp_path: Path, share: float, is_doubt: bool) -> None:
    """As after a block of the file was replaced by another one."""
    rows = export_rows(SMOOTH)
    moved = np.random.default_rng(0).permutation(len(rows))[: int(share * len(rows))]
    rows[moved] = rows[np.roll(moved, 1)]
    loaded = load_scene(save_export(tmp_path / "scene", SMOOTH, rows))
    assert loaded.scene.has_own_pixels
    assert noted(loaded.doubts, "far from their own pixels", "copy or export it again") == is_doubt


def test_files_that_may_be_cameras_of_an_unknown_layout_are_named(tmp_path: Path) -> None:
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH, KINDS["voxels"]))
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "my_rig.json").write_text('{"cams": [{"mat": [1, 2]}]}')
    (tmp_path / "README.txt").write_text("a scene")
    notes = load_scene(tmp_path).notes
    assert noted(notes, "are not used", "no cameras", "my_rig.json")
    assert not noted(notes, "README.txt")
