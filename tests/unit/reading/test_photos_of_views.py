"""Each view has the photo that shows it, or none, whatever the files beside the scene are called."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from messages import names, noted
from PIL import Image, features
from plyfile import PlyData, PlyElement
from shared import write_scene
from sweeps import sweep

from gsmerge.errors import SceneError
from gsmerge.reading.alignment import unaligned
from gsmerge.reading.read_scene import Loaded, load_scene

VIEWS, WIDTH, HEIGHT = 4, 128, 96
MIDDLE = slice(28, 100)  # columns of a portrait
TAGS = {0: 1, 2: 3, 3: 6, 1: 8}  # of orientation, by the quarters that viewers turn a picture counterclockwise


def write_room(folder: Path) -> Path:
    """Write a scene of which each row has its pixel."""
    return write_scene(folder, num_views=VIEWS, width=WIDTH, height=HEIGHT)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the scene of :func:`write_room`, which a test may change."""
    return write_room(tmp_path / "scene")


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Return the photos of all views ``[v,h,w,3]``."""
    return np.stack([read(path) for path in photos_in(write_room(tmp_path_factory.mktemp("photos") / "room"))])


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    return image[..., ::-1].astype(np.float32) / 255


def photos_in(folder: Path) -> list[Path]:
    return sorted((folder / "images").iterdir())


def right_ones(loaded: Loaded, truth: np.ndarray) -> list[bool]:
    """Return whether each view has its photo."""
    assert loaded.scene.images is not None
    return [bool(np.abs(a - b).mean() < 0.02) for a, b in zip(loaded.scene.images, truth, strict=True)]


def load_with_right_photos(folder: Path, truth: np.ndarray) -> Loaded:
    """Load a scene, and check that each view has its photo."""
    loaded = load_scene(folder)
    assert right_ones(loaded, truth) == [True] * VIEWS
    return loaded


def absent(loaded: Loaded) -> list[int]:
    return sorted({*range(VIEWS)} - {*loaded.scene.photo_views})


def name_frames(folder: Path, rename: Callable[[int, str], str]) -> None:
    """Change the names of photos in the cameras' file."""
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    for view, frame in enumerate(data["frames"]):
        frame["file_path"] = rename(view, frame["file_path"])
    path.write_text(json.dumps(data))


def test_right_names_are_used_without_a_word(folder: Path, truth: np.ndarray) -> None:
    loaded = load_with_right_photos(folder, truth)
    assert not any("photo" in text for text in loaded.notes)


@pytest.mark.parametrize("tagged", [True, False])
def test_photos_that_lie_on_their_side_are_turned(folder: Path, truth: np.ndarray, tagged: bool) -> None:
    """As a phone writes them, with a tag that says how to hold them, or without."""
    for path, quarters in zip(photos_in(folder), (3, 0, 1, 2), strict=True):
        exif = Image.Exif()
        if tagged:
            exif[0x0112] = TAGS[quarters]
        lying = np.rot90((read(path) * 255).round().astype(np.uint8), -quarters)
        Image.fromarray(np.ascontiguousarray(lying)).save(path, exif=exif)
    loaded = load_with_right_photos(folder, truth)
    assert any("are turned" in text and "3 of 4 photos" in text for text in loaded.notes) is not tagged


def test_no_cameras_are_searched_for_photos_that_all_lie_on_their_side(
    folder: Path, truth: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The Gaussians lie in the pixels of the cameras as these are."""
    exif = Image.Exif()
    exif[0x0112] = TAGS[1]
    for path in photos_in(folder):
        lying = np.rot90((read(path) * 255).round().astype(np.uint8), -1)
        Image.fromarray(np.ascontiguousarray(lying)).save(path, exif=exif)
    monkeypatch.setattr(unaligned, "find_frame", None)
    assert not load_with_right_photos(folder, truth).notes


def test_cameras_without_a_photo_and_gaussians_are_left_out(folder: Path, truth: np.ndarray) -> None:
    """As of a file of the whole capture, of which a model saw some photos."""
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    frames = data["frames"]
    pose = np.array(frames[0]["transform_matrix"])
    pose[:3, 3] += pose[:3, 0] / 10
    frames[2:2] = [dict(frames[0], file_path="images/unseen.png", transform_matrix=pose.tolist())]
    path.write_text(json.dumps(data))
    loaded = load_with_right_photos(folder, truth)
    assert noted(loaded.doubts, "1 of 5 cameras", "left out", "images/unseen.png")
    assert len(loaded.doubts) == 1


def test_mirrored_photos_are_mirrored_back(folder: Path, truth: np.ndarray) -> None:
    for path in photos_in(folder):
        Image.fromarray(np.ascontiguousarray((read(path) * 255).round().astype(np.uint8)[:, ::-1])).save(path)
    loaded = load_with_right_photos(folder, truth)
    assert any("or mirrored" in text and "4 of 4 photos" in text for text in loaded.notes)


def test_wrong_tags_of_upright_photos_are_undone(folder: Path, truth: np.ndarray) -> None:
    """A program has turned the pixels, and kept the tag."""
    exif = Image.Exif()
    exif[0x0112] = 6
    for path in photos_in(folder):
        Image.open(path).convert("RGB").save(path, exif=exif)
    loaded = load_with_right_photos(folder, truth)
    assert any("4 of 4 photos are turned" in text for text in loaded.notes)


def test_a_photo_without_a_camera_is_named(folder: Path, truth: np.ndarray) -> None:
    """As where a program could not place it; of a film whose frames mostly have none, nothing is said."""
    spare = photos_in(folder)[0]
    spare.with_name("spare.png").write_bytes(spare.read_bytes())
    loaded = load_with_right_photos(folder, truth)
    assert any(names(text, "no camera", "1 of 5", "spare.png") for text in loaded.notes)
    for number in range(VIEWS):
        spare.with_name(f"frame {number}.png").write_bytes(spare.read_bytes())
    assert not any("no camera" in text for text in load_scene(folder).notes)


def test_a_photo_of_something_else_is_left_out_with_its_view_in_one_note(folder: Path) -> None:
    """One note says so; none that its camera is missing."""
    other = photos_in(folder)[0]
    stripes = np.zeros_like((read(other) * 255).astype(np.uint8))
    stripes[::3, :, 1] = 200
    Image.fromarray(stripes).save(other)
    notes = load_scene(folder).notes
    assert any(names(text, "1 of 4 views are left out", other.name, "shows something else") for text in notes)
    assert not any("no camera" in text for text in notes)


def test_a_photo_with_the_ending_of_a_format_that_is_not_read_is_a_doubt(folder: Path) -> None:
    path = photos_in(folder)[1]
    path.rename(path.with_suffix(".HEIC"))
    assert names(str(load_scene(folder).doubts), path.name, ".HEIC is not read", f"{path.parent}/*.HEIC")


@pytest.mark.parametrize(
    ("start", "name"),
    [
        (b"II+\0\x08\0\0\0", "BigTIFF"), (b"\0\0\0\x18ftypheic", "HEIC"), (b"v/1\x01\2\0\0\0", "OpenEXR"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"), (b"\0\0\0\x0cjP  \r\n\x87\n", "JPEG 2000"), (b"GIF89a", "GIF"),
        (b"#?RADIANCE\n", "Radiance"), (b"8BPS\0\1", "Photoshop"), (b"FUJIFILMCCD-RAW 0201", "raw"),
    ],
)  # fmt: skip
def test_a_photo_with_content_in_a_format_that_is_not_read_is_a_doubt(folder: Path, start: bytes, name: str) -> None:
    """Whatever its ending says; the note says how to go on."""
    path = photos_in(folder)[1]
    path.write_bytes(start.ljust(4096, b"\x80"))
    assert names(str(load_scene(folder).doubts), path.name, name, f"{path.parent}/*.png")


def test_photos_of_a_format_that_is_not_read_are_one_sentence(folder: Path) -> None:
    for path in photos_in(folder):
        path.write_bytes(b"\0\0\0\x18ftypheic".ljust(4096, b"\x80"))
    (doubt,) = (text for text in load_scene(folder).doubts if "HEIC" in text)
    assert (doubt.count("HEIC"), doubt.count("mogrify")) == (1, 1)


@pytest.mark.parametrize("ending", ["tif", "avif"])
def test_photos_in_tiff_and_avif_are_read(folder: Path, truth: np.ndarray, ending: str) -> None:
    if ending == "avif" and not features.check("avif"):
        pytest.skip("Pillow was built without libavif")
    for path in photos_in(folder):
        own = Image.fromarray((read(path) * 255).round().astype(np.uint8))
        own.save(
            path.with_suffix(f".{ending}"), **({"quality": 95, "subsampling": "4:4:4"} if ending == "avif" else {})
        )
        path.unlink()
    cameras = folder / "transforms.json"
    cameras.write_text(cameras.read_text().replace(".png", f".{ending}"))
    loaded = load_scene(folder)
    assert not loaded.doubts
    assert right_ones(loaded, truth) == [True] * 4


@sweep("sizes", ["apart", "of all"])
def test_photo_of_another_shape_is_used_if_its_camera_has_its_shape(
    folder: Path, truth: np.ndarray, sizes: str
) -> None:
    """A portrait among landscapes: it is extended with its Gaussians' pixels, or its view is left out."""
    path, file = photos_in(folder)[3], folder / "transforms.json"
    picture = (read(path)[:, MIDDLE] * 255).astype(np.uint8)
    Image.fromarray(picture).save(path)
    data = PlyData.read(str(folder / "scene.ply"), mmap=False)
    rows = data["vertex"].data.reshape(VIEWS, HEIGHT, WIDTH)
    kept = np.concatenate([rows[:3].reshape(-1), rows[3, :, MIDDLE].reshape(-1)])
    PlyData([PlyElement.describe(kept, "vertex")]).write(str(folder / "scene.ply"))
    cameras = json.loads(file.read_text())
    if sizes == "apart":
        common = {key: cameras[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        for frame in cameras["frames"]:
            frame |= common
        cameras["frames"][3] |= {"w": MIDDLE.stop - MIDDLE.start, "cx": common["cx"] - MIDDLE.start}
        cameras = {key: value for key, value in cameras.items() if key not in common}
        file.write_text(json.dumps(cameras))
    loaded = load_scene(folder)
    assert len(loaded.scene.photo_views) == (4 if sizes == "apart" else 3)
    photos = np.asarray(loaded.scene.images)[:3]
    assert np.abs(photos - truth[:3]).mean((1, 2, 3)).max() < 0.02
    if sizes == "apart":
        assert loaded.scene.has_own_pixels
        assert not loaded.doubts
        return
    assert names(str(loaded.doubts), "1 of 4 views", path.name)
    assert not any("no camera" in note for note in loaded.notes)


def test_a_photo_of_another_shape_than_its_camera_is_left_out_alone(folder: Path, truth: np.ndarray) -> None:
    """Only the photo is left out: the view keeps its camera, and all rows their pixels."""
    path = photos_in(folder)[1]
    Image.fromarray((read(path) * 255).astype(np.uint8)).resize((100, 100)).save(path)
    loaded = load_scene(folder)
    assert absent(loaded) == [1]
    assert loaded.scene.has_own_pixels
    assert [right for view, right in enumerate(right_ones(loaded, truth)) if view != 1] == [True] * 3
    assert loaded.doubts
    assert names(str(loaded.doubts), "photos of 1 of 4 views", path.name, "100 x 100", f"{WIDTH} x {HEIGHT}")


@pytest.mark.slow
def test_photos_that_no_camera_names_beside_rows_of_nothing_are_refused(folder: Path) -> None:
    """Are refused with the reason why the cameras are."""
    name_frames(folder, lambda view, name: f"elsewhere/{view}.png")
    photos_in(folder)[0].unlink()
    data = PlyData.read(str(folder / "scene.ply"), mmap=False)
    data["vertex"].data = data["vertex"].data[:50]
    data["vertex"].data["z"] += 1e6
    data.write(str(folder / "scene.ply"))
    with pytest.raises(SceneError):
        load_scene(folder, cameras=folder / "transforms.json", images=folder / "images")


@pytest.mark.slow
@sweep("view", [0, 2, 3])
def test_views_without_gaussians_are_not_there_where_cameras_are_estimated(
    folder: Path, truth: np.ndarray, view: int
) -> None:
    (folder / "transforms.json").unlink()
    data = PlyData.read(str(folder / "scene.ply"), mmap=False)
    rows = data["vertex"].data
    for name in rows.dtype.names:
        rows[name].reshape(VIEWS, -1)[view] = np.nan
    data.write(str(folder / "scene.ply"))
    assert right_ones(load_scene(folder), np.delete(truth, view, 0)) == [True] * 3


def test_smaller_copies_of_photos_are_used_where_they_are_alone(folder: Path, truth: np.ndarray) -> None:
    (folder / "images").rename(folder / "images_4")
    loaded = load_with_right_photos(folder, truth)
    assert absent(loaded) == []


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def dangle(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere.png")


@pytest.mark.parametrize(
    "spoil",
    [os.unlink, lambda path: path.write_bytes(b""), cut_off, dangle],
    ids=["missing", "empty", "cut off", "a link to nothing"],
)
def test_missing_or_damaged_photo_leaves_out_its_view_alone(
    folder: Path, truth: np.ndarray, spoil: Callable[[Path], object]
) -> None:
    path = photos_in(folder)[1]
    spoil(path)
    loaded = load_scene(folder)
    assert absent(loaded) == [1]
    assert [right for view, right in enumerate(right_ones(loaded, truth)) if view != 1] == [True] * 3
    assert loaded.doubts
    assert names(str(loaded.doubts), "photos of 1 of 4 views are left out", path.name)


def test_photos_under_names_of_others_are_matched_by_content(folder: Path, truth: np.ndarray) -> None:
    """As where a film's frames were numbered anew."""
    paths = photos_in(folder)
    contents = [path.read_bytes() for path in paths]
    for view, path in enumerate(paths):
        path.write_bytes(contents[(view + 1) % VIEWS])
    loaded = load_with_right_photos(folder, truth)
    assert any("matched with views by their content" in text and ": photo " in text for text in loaded.notes)


def test_photos_of_other_numbers_are_matched_by_content(folder: Path, truth: np.ndarray) -> None:
    """Files 8 to 11, newest first, for cameras that name others."""
    for view, path in enumerate(photos_in(folder)):
        path.rename(path.with_name(f"{11 - view}.png"))
    name_frames(folder, lambda view, _: f"images/frame_{view}.png")
    assert right_ones(load_scene(folder), truth) == [True] * VIEWS


def test_thumbnails_stand_for_no_photo(folder: Path, truth: np.ndarray) -> None:
    """Nor do hidden copies, nor smaller ones below."""
    for place in (".thumbs", "thumbs", "images_2"):
        (folder / "images" / place).mkdir()
    for path in [path for path in photos_in(folder) if path.is_file()]:
        small = cv2.resize(cv2.imread(str(path)), (32, 24))
        for place in (".thumbs", "thumbs", "images_2"):
            cv2.imwrite(str(path.parent / place / path.name), small)
    name_frames(folder, lambda _, name: Path(name).name)
    loaded = load_with_right_photos(folder, truth)
    assert absent(loaded) == []
