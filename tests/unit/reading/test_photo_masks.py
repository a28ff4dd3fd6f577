"""Masks lie beside the photos or inside them, and bars around photos are cut off."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import names, noted, refuses
from sweeps import sweep
from tiny_scene import Tiny

from gsmerge.errors import SceneError
from gsmerge.io.image_names import match_masks
from gsmerge.io.photo_files import decode_alpha, decode_levels
from gsmerge.jobs.inspect import inspect
from gsmerge.method.geometry.views import subset
from gsmerge.reading.read_scene import load_scene, read_scene


def half(tiny: Tiny) -> np.ndarray:
    """Return a mask of the left half."""
    mask = np.zeros((tiny.height, tiny.width), bool)
    mask[:, : tiny.width // 2] = True
    return mask


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


NAMINGS: list[Callable[[str], str]] = [
    lambda name: name,  # masks/a b/2.png
    lambda name: f"{name}.png",  # COLMAP: masks/a b/2.png.png
    lambda name: Path(name).name,  # masks/2.png
]


@pytest.mark.parametrize("naming", NAMINGS)
def test_masks_beside_the_photos_are_found_by_their_names(
    tiny_folder: Path, tiny: Tiny, naming: Callable[[str], str]
) -> None:
    write(tiny_folder / "masks" / naming(tiny.names[1]), half(tiny).astype(np.uint8) * 255)
    load = load_scene(tiny_folder)
    assert np.array_equal(load.scene.masks[1], half(tiny))
    assert load.scene.masks[[0, 2]].all()  # they have none
    assert "masks leave out 17 % of the photos' pixels, in 1 of 3 photos" in load.notes


def test_masks_in_a_folder_belong_to_the_photos_in_the_folder_of_its_name(tmp_path: Path) -> None:
    """Unless no photo is in one."""
    for name in ("images/a/1.png", "images/b/1.png", "masks/a/1.png", "cut/c/1.png"):
        write(tmp_path / name, np.zeros((2, 2), np.uint8))
    photos = [str(tmp_path / "images" / name) for name in ("a/1.png", "b/1.png")]
    assert match_masks(tmp_path / "masks", photos)[0] == [tmp_path / "masks/a/1.png", None]
    assert match_masks(tmp_path / "cut", photos)[0] == [tmp_path / "cut/c/1.png"] * 2
    masks, notes = match_masks(tmp_path / "masks", photos[1:], named=False)
    assert masks == [None]
    assert noted(notes, "masks are not used", tmp_path / "masks", "1.png")


def test_masks_of_views_without_names_are_taken_in_order(tmp_path: Path) -> None:
    for number in (2, 10, 1):
        cv2.imwrite(str(tmp_path / f"IMG_{number}.png"), np.zeros((2, 2), np.uint8))
    masks, notes = match_masks(tmp_path, ["view 0", "view 1", "view 2"])
    assert [mask.name for mask in masks if mask] == ["IMG_1.png", "IMG_2.png", "IMG_10.png"]
    assert noted(notes, tmp_path, "in order")
    for others in (["view 0"], ["a", "b", "c"]):
        with refuses(SceneError, tmp_path, f"{others[0]}.png"):
            match_masks(tmp_path, others)
    with refuses(SceneError, tmp_path, "each of the 4 views", "3 pictures"):
        match_masks(tmp_path, [f"view {view}" for view in range(4)])
    assert match_masks(tmp_path, ["view 0", "view 1", "view 2"], named=False)[0] == [None] * 3


def test_a_folder_of_masks_that_is_named_is_used_or_refused(tiny_folder: Path, tiny: Tiny, tmp_path: Path) -> None:
    """Of twice the size, in another format, of 0 and 1."""
    large = half(tiny).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    for name in tiny.names:
        write(tmp_path / "other" / Path(name).with_suffix(".bmp"), large)
    scene = read_scene(tiny_folder, masks=tmp_path / "other")
    assert np.array_equal(scene.masks, np.stack([half(tiny)] * 3))
    with pytest.raises(SceneError, match="no such"):
        read_scene(tiny_folder, masks=tmp_path / "missing")
    with refuses(SceneError, "scene.ply", "--masks", "file"):
        read_scene(tiny_folder, masks=tiny_folder / "scene.ply")
    shutil.copytree(tmp_path / "other" / "a b", tmp_path / "wrong")
    for number, path in enumerate(sorted((tmp_path / "wrong").iterdir())):
        path.rename(path.with_name(f"x{number}.bmp"))
    with refuses(SceneError, "wrong", "2.png", "--masks"):
        read_scene(tiny_folder, masks=tmp_path / "wrong")


def test_where_photos_are_transparent_they_do_not_count(tiny_folder: Path, tiny: Tiny) -> None:
    alpha = half(tiny).astype(np.uint8) * 255
    for name, image in zip(tiny.names, tiny.images, strict=True):
        write(tiny_folder / "images" / name, np.dstack([image[..., ::-1], alpha]))
    scene = read_scene(tiny_folder)
    assert np.array_equal(scene.masks, np.stack([half(tiny)] * 3))
    assert np.array_equal((scene.images * 255).round(), tiny.images)


def test_opaque_photos_have_no_masks(tiny_folder: Path, tiny: Tiny) -> None:
    path = tiny_folder / "images" / tiny.names[0]
    write(path, np.dstack([tiny.images[0][..., ::-1], np.full((tiny.height, tiny.width), 255, np.uint8)]))
    assert decode_alpha(path) is None
    assert read_scene(tiny_folder).masks is None


def test_mask_that_is_no_image_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\0no image")
    with pytest.raises(SceneError, match="decoded"):
        decode_levels(tmp_path / "a.png")


def test_bars_around_photos_are_cut_off(tiny_folder: Path, tiny: Tiny) -> None:
    for name, image in zip(tiny.names, tiny.images, strict=True):
        write(tiny_folder / "images" / name, np.pad(image, ((3, 4), (0, 0), (0, 0)))[..., ::-1])
    load = load_scene(tiny_folder)
    assert np.array_equal((load.scene.images * 255).round(), tiny.images)
    assert "bars around the photos are cut off: 20 x 21 pixels become 20 x 14" in load.notes


def test_a_folder_of_masks_in_a_format_that_is_not_read_is_a_doubt(tmp_path: Path) -> None:
    (tmp_path / "0.tga").write_bytes(b"")
    with refuses(SceneError, tmp_path, "0.png", "1 .tga", "convert"):
        match_masks(tmp_path, ["0.jpg"])


def test_masks_of_many_bits_and_of_transparency_are_read(tmp_path: Path) -> None:
    levels = np.array([[0, 256, 65535, 40000]], np.uint16)
    write(tmp_path / "deep.png", levels)
    assert decode_levels(tmp_path / "deep.png").tolist() == [[0, 1, 255, 156]]
    clear = np.dstack([np.full((1, 4, 3), 255, np.uint8), np.array([[0, 0, 255, 255]], np.uint8)])
    write(tmp_path / "clear.png", clear)
    assert decode_levels(tmp_path / "clear.png").tolist() == [[0, 0, 255, 255]]


@pytest.mark.parametrize("level", [0, 255], ids=["before black", "before white"])
def test_photos_without_their_background_are_masks(tiny_folder: Path, tiny: Tiny, tmp_path: Path, level: int) -> None:
    """As tools that cut out an object write them; their colours are those of the photos."""
    for name, image in zip(tiny.names, tiny.images, strict=True):
        seen = np.where(half(tiny)[..., None], image, level)[..., ::-1].astype(np.uint8)
        write(tmp_path / "cut" / name, np.dstack([seen, half(tiny).astype(np.uint8) * 255]))
    load = load_scene(tiny_folder, masks=tmp_path / "cut")
    assert np.array_equal(load.scene.masks, np.stack([half(tiny)] * 3))
    assert (load.candidates[-1].kind, load.candidates[-1].chosen) == ("masks", True)


def test_a_folder_of_other_masks_beside_the_photos_is_not_used(tiny_folder: Path, tiny: Tiny) -> None:
    write(tiny_folder / "masks" / "object_0.png", half(tiny).astype(np.uint8) * 255)
    load = load_scene(tiny_folder)
    assert load.scene.masks is None
    assert not load.doubts
    assert noted(load.notes, "masks are not used", tiny_folder / "masks", "found none")


def test_masks_without_photos_are_noted(tiny_folder: Path, tiny: Tiny) -> None:
    write(tiny_folder / "masks" / tiny.names[0], half(tiny).astype(np.uint8) * 255)
    shutil.rmtree(tiny_folder / "images")
    assert "the pictures of --masks are not used, since there are no photos" in load_scene(tiny_folder).notes


def test_bright_pixels_count_by_their_opacity(tmp_path: Path) -> None:
    """Rows beyond the first that are converted at once count, too."""
    levels = np.random.default_rng(0).integers(0, 256, (600, 3, 2), np.uint8)
    write(tmp_path / "a.png", np.dstack([levels[..., 0]] * 3 + [levels[..., 1]]))
    products = levels[..., 0].astype(int) * levels[..., 1]
    assert np.array_equal(decode_levels(tmp_path / "a.png"), np.round(products / np.float32(255)))


@pytest.mark.parametrize(("most", "dtype", "white"), [
    (1, np.uint8, 255), (64, np.uint8, 64), (255, np.uint8, 255), (1, np.uint16, 255), (32768, np.uint16, 128),
])  # fmt: skip
def test_levels_of_a_mask_are_its_greys_unless_only_0_and_1(tmp_path: Path, most: int, dtype: type, white: int) -> None:
    """Only a picture of 0 and 1 alone is stretched."""
    write(tmp_path / "a.png", np.array([[0, most, 0]], dtype))
    assert decode_levels(tmp_path / "a.png").tolist() == [[0, white, 0]]


def test_mask_may_take_as_much_memory_as_its_photo_allows(tmp_path: Path) -> None:
    mask, photo = tmp_path / "mask.png", tmp_path / "photo.jpg"
    write(mask, np.full((6000, 6000), 255, np.uint8))
    photo.write_bytes(bytes(1_000_000))
    with refuses(SceneError, mask, "6000 x 6000", "108 MB"):
        decode_levels(mask)
    assert (decode_levels(mask, photo) == 255).all()


def test_grey_of_a_mask_is_the_weight_of_its_pixel(tiny_folder: Path, tiny: Tiny) -> None:
    """Where it counts at all; black and white pixels have the weights that they have without greys."""
    mask = half(tiny).astype(np.uint8) * 255
    mask[:, 0] = 204
    write(tiny_folder / "masks" / tiny.names[1], mask)
    scene = read_scene(tiny_folder)
    assert np.array_equal(scene.masks[1], half(tiny))
    assert np.allclose(scene.importance[1][:, 0], 0.8)
    assert (scene.importance[1][:, 1 : tiny.width // 2] == 1).all()
    assert (scene.importance[[0, 2]] == 1).all()
    assert scene.protected is None


def test_protected_pixels_count_four_times(tiny_folder: Path, tiny: Tiny, tmp_path: Path) -> None:
    levels = half(tiny).astype(np.uint8) * 255
    levels[:, 0] = 51
    write(tmp_path / "signs" / tiny.names[1], levels)
    load = load_scene(tiny_folder, protect=tmp_path / "signs")
    scene = load.scene
    assert scene.masks is None
    assert np.allclose(scene.importance[1][:, 0], 1.6)
    assert (scene.importance[1][half(tiny) & (levels == 255)] == 4).all()
    assert (scene.importance[1][~half(tiny)] == 1).all()
    assert np.array_equal(scene.protected[1], levels == 255)
    assert (scene.importance[[0, 2]] == 1).all()
    (note,) = (note for note in load.notes if note.startswith("protect: "))
    assert note.endswith("of 1 photo of 3")
    assert subset(scene, [1, 2]).importance.shape[0] == 2


def test_pictures_to_protect_that_do_not_fit_are_refused(tiny_folder: Path, tiny: Tiny, tmp_path: Path) -> None:
    with refuses(SceneError, "missing", "no such"):
        read_scene(tiny_folder, protect=tmp_path / "missing")
    with refuses(SceneError, "scene.ply", "--protect", "file"):
        read_scene(tiny_folder, protect=tiny_folder / "scene.ply")
    write(tmp_path / "wrong" / "sign.png", np.zeros((2, 2), np.uint8))
    with refuses(SceneError, "wrong", "2.png", "--protect"):
        read_scene(tiny_folder, protect=tmp_path / "wrong")


def speckle(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, shape, np.uint8)


def soften(mask: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(mask, (0, 0), 2)


PICTURES: dict[
    str, tuple[bool, Callable[[np.ndarray, np.ndarray], np.ndarray]]
] = {  # of a photo and a mask of 2 levels
    "the photo": (True, lambda photo, _: photo),
    "another photo": (True, lambda photo, _: speckle(photo.shape)),
    "the photo in grey": (True, lambda photo, _: cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY)),
    "another photo in grey": (True, lambda photo, _: speckle(photo.shape[:2])),
    "a part of the photo on black": (True, lambda photo, mask: photo * (mask > 0)[..., None]),
    "a mask": (False, lambda _, mask: mask),
    "a mask of 0 and 1": (False, lambda _, mask: mask // 255),
    "soft edges": (False, lambda _, mask: soften(mask)),
    "equal channels": (False, lambda _, mask: np.dstack([soften(mask)] * 3)),
    "opacity": (False, lambda _, mask: np.dstack([mask] * 4)),
    "one colour": (False, lambda _, mask: np.dstack([mask // 9, mask, mask // 2])),
    "levels": (False, lambda _, mask: mask // 255 * np.linspace(130, 255, mask.shape[1]).astype(np.uint8)),
    "holes everywhere": (False, lambda _, mask: mask | speckle(mask.shape) // 128 * 255),
}


@pytest.mark.parametrize(("kind", "is_photo"), [("another photo", True), ("another photo in grey", False)])
def test_photo_among_masks_keeps_the_masks_from_use(tiny_folder: Path, tiny: Tiny, kind: str, is_photo: bool) -> None:
    """Colours say for certain that it is a photo; most greys have to."""
    for number, name in enumerate(tiny.names):
        mask = half(tiny).astype(np.uint8) * 255
        write(tiny_folder / "masks" / name, mask if number else PICTURES[kind][1](tiny.images[0], mask))
    load = load_scene(tiny_folder)
    assert (bool(load.doubts), load.scene.masks is None) == (is_photo, is_photo)


@pytest.mark.parametrize("is_inverted", [False, True])
def test_found_masks_that_hide_most_of_the_scene_are_none(tmp_path: Path, is_inverted: bool) -> None:
    scene = smooth_scene(56, 40)
    folder = save_export(tmp_path / "scene", scene, export_rows(scene))
    mask = np.full((40, 56), 255, np.uint8)
    mask[:, :12] = 0
    for name in scene.names:
        write(folder / "masks" / name, 255 - mask if is_inverted else mask)
    load = load_scene(folder)
    assert (load.scene.masks is None) == is_inverted
    said = [names(doubt, "leave out 79 %", "invert them", "--masks none") for doubt in load.doubts]
    assert said == [True] * is_inverted
    named = load_scene(folder, masks=folder / "masks")
    assert named.scene.masks is not None
    assert not named.doubts


def test_an_alpha_that_hides_most_of_what_gaussians_show_is_none(tmp_path: Path) -> None:
    """A confidence, say, here of a scene whose rows are no pixels."""
    scene = smooth_scene(56, 40)
    rows = export_rows(scene)
    folder = save_export(tmp_path / "scene", scene, rows[np.random.default_rng(0).permutation(len(rows))])
    confidence = np.full((40, 56), 90, np.uint8)
    confidence[15:25, 20:30] = 255
    for name in scene.names:
        path = folder / "images" / name
        write(path, np.dstack([cv2.imread(str(path)), confidence]))
    load = load_scene(folder)
    assert load.scene.masks is None
    assert names(str(load.doubts), "masks are not used: transparency", "most of what the Gaussians show")


def test_grey_edges_of_a_mask_change_no_dark_pixel(tiny_folder: Path, tiny: Tiny) -> None:
    soft = np.where(half(tiny), 255, 0).astype(np.uint8)
    soft[:, tiny.width // 2 - 1] = 200
    write(tiny_folder / "masks" / tiny.names[0], soft)
    importance = load_scene(tiny_folder).scene.importance
    assert (importance[0, :, : tiny.width // 2 - 1] == 1).all()
    assert (importance[0, :, tiny.width // 2 :] == 1).all()  # where the mask is dark; there photos do not count anyway
    assert (importance[0, :, tiny.width // 2 - 1] < 1).all()


@sweep("ending", [".jpg", ".png"])
@pytest.mark.parametrize("kind", PICTURES)
def test_photos_in_place_of_masks_are_refused(tmp_path: Path, kind: str, ending: str) -> None:
    """By their colours, or where greys change as those of the photo do; found beside the scene, they are left out."""
    is_photo, draw = PICTURES[kind]
    scene = smooth_scene(56, 40)
    folder = save_export(tmp_path / "scene", scene, export_rows(scene))
    mask = np.zeros((40, 56), np.uint8)
    mask[:, 12:] = 255
    for name, image in zip(scene.names, scene.images, strict=True):
        noisy = np.clip(image[..., ::-1] + np.random.default_rng(1).normal(0, 4, image.shape), 0, 255).astype(np.uint8)
        write(folder / "masks" / Path(name).with_suffix(ending), draw(noisy, mask))
    load, named = load_scene(folder), dict.fromkeys(("masks", "protect"), folder / "masks")
    assert (bool(load.doubts), load.scene.masks is None) == (is_photo, is_photo)
    if not is_photo:
        assert load_scene(folder, masks="none", protect=named["protect"]).scene.importance is not None
        return
    assert names(str(load.doubts), "masks are left out", folder / "masks", "3 of 3", "--masks none")
    for option, place in named.items():
        with refuses(SceneError, "masks", "3 of 3", f"--{option} none"):
            load_scene(folder, **{"masks": "none", option: place})
    assert names(str(inspect(folder, masks=folder / "masks")["alignment_problem"]), "3 of 3", "--masks none")
    document = json.loads((folder / "transforms.json").read_text())
    for frame, name in zip(document["frames"], scene.names, strict=True):
        frame["mask_path"] = Path("masks", name).with_suffix(ending).as_posix()
    (folder / "transforms.json").write_text(json.dumps(document))
    with refuses(SceneError, "transforms.json", "3 of 3", "--masks none"):
        load_scene(folder)


def test_no_masks_wanted_means_no_transparency(tiny_folder: Path, tiny: Tiny) -> None:
    """--masks none, so that a photo whose alpha is something else counts whole."""
    for name, image in zip(tiny.names, tiny.images, strict=True):
        write(tiny_folder / "images" / name, np.dstack([image, half(tiny).astype(np.uint8) * 255]))
    assert load_scene(tiny_folder).scene.masks is not None
    assert load_scene(tiny_folder, masks="none").scene.masks is None
