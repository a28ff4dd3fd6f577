from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from exports import depth_map_mask, export_rows, save_export, smooth_scene
from messages import names, noted
from tiny_scene import Tiny, write_colmap_text, write_images, write_npz

from gsmerge import CompactOptions, compact, read_scene
from gsmerge.io import read_ply, write_gaussians, write_ply
from gsmerge.io.formats.rows import RESULT_COMMENT
from gsmerge.jobs.estimate import estimate
from gsmerge.jobs.inspect import inspect, inspection_lines
from gsmerge.prepare.prepare_scene import views_notes
from gsmerge.scoring.coverage import extents


def test_inspecting_a_scene_that_fits_reports_its_facts(tiny_folder: Path, tiny: Tiny) -> None:
    actual = inspect(tiny_folder)
    assert json.loads(json.dumps(actual, allow_nan=False)) == actual
    assert actual["count"] == 840
    assert actual["bytes"] == (tiny_folder / "scene.ply").stat().st_size
    assert sum(actual["bytes_by_attribute"].values()) == 840 * 68
    assert (actual["num_views"], actual["width"], actual["height"]) == (3, 20, 14)
    assert actual["camera_format"] == "transforms.json"
    assert actual["images"] == str(tiny_folder / "images")
    assert actual["alignment"]["ok"]
    assert actual["alignment_problem"] is None
    (note,) = actual["notes"]  # each view has a depth of its own
    assert names(note, f"{100 * actual['agreement']['confirmed']:.0f} %", "confirms", "depth")
    low, high = (np.quantile(tiny.gaussians.means, q, axis=0).tolist() for q in (0.01, 0.99))
    assert actual["extents"]["box_low"] == pytest.approx(low, abs=1e-4)
    assert actual["extents"]["box_high"] == pytest.approx(high, abs=1e-4)


def test_candidates_say_why_cameras_photos_and_masks_were_chosen(tiny_folder: Path, tiny: Tiny) -> None:
    write_colmap_text(tiny_folder / "sparse/0", tiny)
    write_images(tiny_folder / "images", replace(tiny, images=tiny.images[::-1]))
    masks = np.full_like(tiny.images, 255)
    masks[:, :4] = 0
    write_images(tiny_folder / "masks", replace(tiny, images=masks))
    facts = inspect(tiny_folder)
    assert [(one["path"], one["chosen"]) for one in facts["candidates"]] == [
        ("transforms.json", True), ("sparse/0", False), ("images", True), ("masks", True),
    ]  # fmt: skip
    assert facts["candidates"][1]["option"] == f"--cameras {tiny_folder / 'sparse/0'}"
    lines = inspection_lines(facts)
    first = next(i for i, line in enumerate(lines) if line.startswith("candidates"))
    assert lines[first].startswith("candidates cameras  transforms.json  chosen    ")
    assert lines[first].endswith(" % of the Gaussians lie near their pixels")
    assert lines[first + 1].startswith(
        "           cameras  sparse/0         left out  not examined, since others fit ("
    )
    assert lines[first + 2] == "           photos   images           chosen    show 3 of 3 views"
    assert lines[first + 3].endswith("leave out 29 % of the photos' pixels")


def test_candidates_that_see_nothing_or_cannot_be_read_are_left_out(tmp_path: Path) -> None:
    smooth = smooth_scene(48, 36)
    some = np.random.default_rng(0).permutation(3 * 36 * 48)[:2999]
    save_export(tmp_path, smooth, export_rows(smooth, some))
    assert [one["reason"] for one in inspect(tmp_path)["candidates"]] == [
        "see 100 % of the Gaussians", "show 3 of 3 views",
    ]  # fmt: skip
    shutil.rmtree(tmp_path / "images")  # their colours would show how far the cameras are away
    (tmp_path / "transforms.json").write_text("nonsense")
    away = replace(smooth, c2w=smooth.c2w + np.pad([[900.0]], ((0, 3), (3, 0))))
    write_colmap_text(tmp_path / "sparse/0", away)
    first, second, rows = inspect(tmp_path)["candidates"]
    assert names(first["reason"], "expected JSON")
    assert (second["path"], second["reason"]) == ("sparse/0", "see 0 % of the Gaussians")
    assert (rows["path"], rows["chosen"], rows["reason"]) == (
        "estimated",
        False,
        "the Gaussians form no grid of pixels",
    )


@pytest.mark.parametrize(
    ("level", "chosen", "reason"),
    [(255, True, "leave nothing out"), (0, False, "leave out 100 % of the photos' pixels")],
)
def test_masks_have_a_reason(tiny_folder: Path, tiny: Tiny, level: int, chosen: bool, reason: str) -> None:
    write_images(tiny_folder / "masks", replace(tiny, images=np.full_like(tiny.images, level)))
    masks = inspect(tiny_folder)["candidates"][-1]
    assert (masks["kind"], masks["chosen"], masks["reason"]) == ("masks", chosen, reason)


def test_masks_of_other_names_are_left_out(tiny_folder: Path, tiny: Tiny) -> None:
    masks = replace(tiny, images=np.zeros_like(tiny.images), names=("x.png", "y.png", "z.png"))
    write_images(tiny_folder / "masks", masks)
    choice = inspect(tiny_folder)["candidates"][-1]
    assert (choice["kind"], choice["chosen"], choice["reason"]) == ("masks", False, "have the name of no photo")


def test_one_broken_mask_is_named(tiny_folder: Path, tiny: Tiny) -> None:
    write_images(tiny_folder / "masks", tiny)
    broken = sorted((tiny_folder / "masks").rglob("*.png"))[0]
    broken.write_bytes(b"nothing")
    found = inspect(tiny_folder)["candidates"][-1]
    named = inspect(tiny_folder, masks=tiny_folder / "masks")
    assert named["compact"] is None
    for choice in (found, named["candidates"][-1]):
        assert (choice["kind"], choice["chosen"], choice["option"]) == ("masks", False, "")
        assert names(choice["reason"], broken.name)


def test_cameras_whose_photos_are_left_out_are_uncertain(tmp_path: Path) -> None:
    smooth = smooth_scene(48, 36)
    save_export(tmp_path, smooth, export_rows(smooth, np.random.default_rng(0).permutation(3 * 36 * 48)[:2999]))
    noise = np.random.default_rng(0).integers(0, 256, (2, *smooth.images.shape[1:]), np.uint8)
    shutil.rmtree(tmp_path / "images")
    write_images(tmp_path / "images", replace(smooth, images=noise, names=("x.png", "y.png")))
    cameras, photos = inspect(tmp_path)["candidates"]
    assert cameras["reason"] == "see 100 % of the Gaussians, but no photo shows that they fit"
    assert (photos["chosen"], photos["reason"], photos["option"]) == (False, "show none of the views", "")


def test_a_refused_scene_has_candidates_too(tiny_folder: Path, tiny: Tiny, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, tiny.images.shape, np.uint8)
    write_images(tmp_path / "others", replace(tiny, images=noise))
    facts = inspect(tiny_folder, images=tmp_path / "others")
    assert facts["compact"] is None
    assert [(one["kind"], one["chosen"]) for one in facts["candidates"]] == [("cameras", False), ("photos", False)]
    assert facts["candidates"][1]["reason"] == "show none of the views"


def test_a_ply_without_cameras_has_an_alignment_problem(tmp_path: Path, tiny: Tiny) -> None:
    path = tiny.save(tmp_path, cameras=False, images=False) / "scene.ply"
    write_ply(path, tiny.gaussians[np.random.default_rng(0).permutation(840)], overwrite=True)
    actual = inspect(path)
    assert (actual["num_views"], actual["cameras"], actual["camera_format"], actual["images"]) == (0, None, None, None)
    assert actual["alignment"] is None
    assert "cameras" in actual["alignment_problem"]


def test_cameras_that_do_not_fit_are_an_alignment_problem(tiny_folder: Path, tiny: Tiny) -> None:
    some = np.random.default_rng(0).permutation(840)[:700]
    write_ply(tiny_folder / "scene.ply", tiny.gaussians[some], overwrite=True)
    actual = inspect(tiny_folder)
    assert actual["num_views"] == 3
    assert actual["alignment"] is None
    assert "pixel" in str(actual["alignment_problem"])
    (tiny_folder / "transforms.json").write_text("nonsense")
    actual = inspect(tiny_folder, cameras=tiny_folder / "transforms.json")
    assert actual["num_views"] == 0
    assert "expected JSON" in str(actual["alignment_problem"])
    actual = inspect(tiny_folder)
    assert (actual["cameras"], actual["num_views"]) == (None, 0)
    assert noted(actual["notes"], "transforms.json", "and the photos in", "left out", "expected JSON")


def test_odd_values_of_a_ply_are_counted(tiny_folder: Path, tiny: Tiny) -> None:
    opacities, quats, scales = (getattr(tiny.gaussians, f).copy() for f in ("opacities", "quats", "scales"))
    opacities[:4], opacities[4:9] = 1, 0
    scales[3] = 1e14
    odd = replace(tiny.gaussians, opacities=opacities, quats=quats, scales=scales)
    write_ply(tiny_folder / "scene.ply", odd, overwrite=True)
    data = bytearray((tiny_folder / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start : start + 4] = b"\x00\x00\xc0\x7f"  # NaN
    data[start + 2 * 68 - 16 : start + 2 * 68] = bytes(16)  # the quaternion of row 1
    scale = start + 5 * 68 + 40
    data[scale : scale + 4] = b"\x00\x00\x20\x42"  # a log scale of 40
    (tiny_folder / "scene.ply").write_bytes(data)
    actual = inspect(tiny_folder)
    assert (actual["num_nonfinite"], actual["num_zero_quats"]) == (3, 1)
    assert (actual["num_opaque"], actual["num_transparent"]) == (2, 4)
    assert len(actual["notes"]) == 4
    assert noted(actual["notes"], "4 Gaussians fainter than 1/255, which nothing draws")
    assert actual["alignment"] is not None


def test_outliers_and_large_scales_are_reported_as_shares(tiny_folder: Path, tiny: Tiny) -> None:
    means, scales = tiny.gaussians.means.copy(), tiny.gaussians.scales.copy()
    means[:7] += 1000
    scales[:21, 1] = 50
    write_ply(tiny_folder / "scene.ply", replace(tiny.gaussians, means=means, scales=scales), overwrite=True)
    actual = inspect(tiny_folder)["extents"]
    assert actual["share_outliers"] == pytest.approx(7 / 840)
    assert actual["share_huge"] == pytest.approx(21 / 840)
    assert actual["scale_max"] == pytest.approx(50)
    assert 0.01 < actual["scale_median"] < 0.11
    low, high = (np.array(side) for side in (actual["box_low"], actual["box_high"]))
    assert actual["diagonal"] == pytest.approx(float(np.linalg.norm(high - low)))


def test_extents_of_no_or_one_gaussian_are_zero(tiny: Tiny) -> None:
    assert extents(tiny.gaussians[:0])["share_outliers"] == 0
    one = extents(tiny.gaussians[:1])
    assert one["diagonal"] == 0
    assert one["share_outliers"] == 0


def test_coverage_is_reported_for_each_view(tiny_folder: Path, tiny: Tiny) -> None:
    opacities = tiny.gaussians.opacities.copy()
    opacities[280:350] = 0
    write_ply(tiny_folder / "scene.ply", replace(tiny.gaussians, opacities=opacities), overwrite=True)
    actual = inspect(tiny_folder)
    assert [view["share_of_pixels"] for view in actual["coverage"]] == [1, 0.75, 1]
    assert [view["name"] for view in actual["coverage"]] == [f"images/{name}" for name in tiny.names]
    means = tiny.gaussians.means[opacities > 0].astype(np.float64)
    for view, w2c in zip(actual["coverage"], tiny.w2c, strict=True):
        image = (means @ w2c[:3, :3].T + w2c[:3, 3]) @ tiny.K.T
        xy = image[:, :2] / image[:, 2:]
        inside = (image[:, 2] > 0) & (xy >= 0).all(1) & (xy < (20, 14)).all(1)
        assert view["share_of_gaussians"] == pytest.approx(inside.mean())
    assert actual["alignment"]["share_within_1px"] == 1
    assert actual["num_saturated"] == 70
    assert actual["sight"]["share_seen"] == 1


def test_inspecting_estimates_the_result_of_compact(tiny_folder: Path, tmp_path: Path, tiny: Tiny) -> None:
    actual = inspect(tiny_folder)
    result = compact(read_scene(tiny_folder), fit="none")
    assert actual["compact"]["num_gaussians"] == pytest.approx(len(result.gaussians), abs=3)
    write_ply(tmp_path / "small.ply", result.gaussians)
    assert actual["compact"]["bytes"] == pytest.approx((tmp_path / "small.ply").stat().st_size, abs=3 * 68)
    assert actual["compact"]["ratio"] == actual["compact"]["num_gaussians"] / 840
    assert actual["compact"]["seconds"] > 0
    assert actual["compact"]["memory_bytes"] > 1e8


@pytest.fixture
def pruned(tmp_path: Path) -> Path:
    """Save a scene with half of its rows, in no order."""
    smooth = smooth_scene(24, 18)
    some = np.random.default_rng(0).permutation(1296)[:640]
    return replace(smooth, gaussians=smooth.gaussians[some]).save(tmp_path / "scene")


def test_a_scene_without_pixels_is_inspected_by_sight(pruned: Path) -> None:
    actual = inspect(pruned)
    assert actual["alignment"] is None
    assert actual["sight"]["ok"]
    assert [view["share_of_pixels"] for view in actual["coverage"]] == [None] * 3
    assert min(view["share_of_gaussians"] for view in actual["coverage"]) > 0.2
    assert actual["compact"] is not None
    lines = "\n".join(inspection_lines(actual))
    assert "least in images/" in lines
    assert re.search(r"at most [\d,]+ Gaussians \([\d.]+ % of the input\), unless photos need more", lines)
    alone = inspect(pruned / "scene.ply", cameras=pruned / "transforms.json", order="none")
    assert alone["compact"] is not None


def test_a_scene_without_views_has_no_coverage(pruned: Path) -> None:
    (pruned / "transforms.json").unlink()
    alone = inspect(pruned, order="none")
    assert alone["coverage"] == []
    assert alone["sight"] is None
    assert "coverage" not in "\n".join(inspection_lines(alone))
    assert inspect(pruned)["compact"] == alone["compact"]  # photos without cameras are left out


SMOOTH = smooth_scene(48, 36)
PIXELS = np.arange(3 * 36 * 48).reshape(3, 36 * 48)


def lines_by_word(path: Path, **options: Path) -> dict[str, str]:
    """Return the lines by their first word; notes and all lines of one word joined."""
    actual: dict[str, str] = {}
    for line in inspection_lines(inspect(path, **options)):
        word, rest = line[:11].strip(), line[11:]
        actual[word] = f"{actual[word]}; {rest}" if word in actual else rest
    return actual


def test_dropped_pixels_are_counted_as_missing(tmp_path: Path) -> None:
    kept = np.concatenate([np.flatnonzero(depth_map_mask(d)) + i * d.size for i, d in enumerate(SMOOTH.depths)])
    save_export(tmp_path / "gs_ply", SMOOTH, export_rows(SMOOTH, kept), cameras=False, name="0000.ply")
    write_npz(tmp_path / "exports/npz/results.npz", SMOOTH, depth=SMOOTH.depths.astype(np.float32))
    lines = lines_by_word(tmp_path)
    missing = PIXELS.size - len(kept)
    assert names(lines["alignment"], f"none for {missing:,}")
    assert not lines["coverage"].startswith("100 %")
    assert inspect(tmp_path)["num_missing"] == missing


def test_lines_of_a_scene_without_cameras_name_the_remedy(tmp_path: Path) -> None:
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH)[np.lexsort(SMOOTH.gaussians.means.T)], cameras=False)  # no grid
    lines = lines_by_word(tmp_path)
    assert names(lines["alignment"], "not", "no cameras")
    assert names(lines["method"], "pair by pair", "fit: full")
    assert names(lines["note"], "no cameras", "--cameras", "--images")


def test_files_of_gsmerge_are_named_as_such(tmp_path: Path) -> None:
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH))
    write_ply(tmp_path / "own.ply", read_ply(tmp_path / "scene.ply").gaussians[::7])
    own = lines_by_word(tmp_path / "own.ply")
    assert own["exporter"] == "gsmerge"
    assert "not needed" not in own["compact"]  # a converted scene may well be compacted
    write_gaussians(tmp_path / "own.ply", SMOOTH.gaussians[::7], comments=[RESULT_COMMENT], overwrite=True)
    assert names(lines_by_word(tmp_path / "own.ply")["compact"], "not needed", "result of gsmerge")


def test_photos_inside_other_files_are_named(tmp_path: Path, tiny: Tiny) -> None:
    save_export(tmp_path, tiny, export_rows(tiny), cameras=False)
    write_npz(tmp_path / "results.npz", tiny)
    document = inspect(tmp_path)
    photos = next(one["path"] for one in document["candidates"] if one["kind"] == "photos")
    lines = inspection_lines(document | {"images": None})  # as where no folder of photos was found
    assert f"images     {photos}" in lines


def test_a_repeated_view_counts_once_in_the_estimate() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 24, 18))
    again, options = scenes.take_views(scene, [0, 1, 2, 2]), CompactOptions().with_settings({"effort": "draft"})
    said = "1 view repeats another in every pixel and counts once"
    assert said in views_notes(again)
    assert said in compact(again, options).report.choices["changes"]
    assert views_notes(scene) == []
    assert estimate(again, options)["num_gaussians"] == estimate(scene, options)["num_gaussians"]
