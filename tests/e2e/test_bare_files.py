"""Each command runs on a file beside which nothing lies; photos without cameras are not passed over."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import unaligned_scenes
from messages import noted
from shared import write_smallest
from sweeps import sweep

import gsmerge

PLACED = ("no cameras", "--cameras", "--images", "cannot be better than its input")


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file alone in its folder. Read only."""
    folder = tmp_path_factory.mktemp("bare")
    scene = gsmerge.read_scene(write_smallest(folder / "made"))
    path = folder / "alone" / "scene.ply"
    gsmerge.write_ply(path, unaligned_scenes.voxels(scene, 0.05).gaussians)
    return path


def report_of(run: Any, *words: Any) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(run(*words, "--json", code=0).out)
    return document


def test_compact_needs_no_hint_for_a_bare_file(bare: Path, tmp_path: Path, run: Any) -> None:
    report = report_of(run, "compact", bare, "-o", tmp_path / "small.ply", "--budget", "20%")
    assert sum(noted([note], *PLACED) for note in report["notes"]) == 1
    assert not noted(report["notes"], "Depth Anything 3")
    assert report["output"]["num_gaussians"] == report["input"]["num_gaussians"] // 5
    judged = report["choices"]["fidelity"]
    assert judged["views"] >= 3
    assert judged["psnr"] > 20
    assert judged["held_out"]
    assert report["psnr_input_views"] == {"before": None, "after": None}
    assert "unseen" not in report["choices"]
    said = run("compact", bare, "-o", tmp_path / "b.ply", "--budget", "20%", "--hint", "order=none", code=0)
    assert (tmp_path / "small.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert all(note in said.err for note in report["notes"])
    assert f"dB  from the input in {judged['views']} held-out views" in said.out


@sweep(
    "words",
    [
        "compact BARE --dry-run", "inspect BARE", "evaluate BARE SMALL --lpips none",
        "render BARE SMALL --views 2 -o OUT.png",
        "extend OUT.gsm BARE --set superpixels=40 --set checkpoint=none",
        "view BARE SMALL -o OUT.html --no-open", "render BARE --path orbit --frames 2 -o OUT",
    ],
    often=5,
)  # fmt: skip
def test_other_commands_need_no_hint_for_a_bare_file(words: str, bare: Path, tmp_path: Path, run: Any) -> None:
    small = tmp_path / "small.ply"
    if "SMALL" in words:
        gsmerge.write_ply(small, gsmerge.read_ply(bare).gaussians[::9])
    places = {"BARE": bare, "SMALL": small, "OUT": tmp_path / "out"}
    parts = words.split()
    for name, place in places.items():
        parts = [part.replace(name, str(place)) for part in parts]
    document = report_of(run, *parts)
    assert document.get("reference", "renders of the input") == "renders of the input"
    notes = (document.get("batches") or [document])[0]["notes"]
    expected = ("views are placed", "around") if "render" in words else PLACED
    assert sum(noted([note], *expected) for note in notes) == 1


@pytest.mark.slow
def test_counts_are_judged_by_views_that_nothing_was_fitted_to(bare: Path, tmp_path: Path, run: Any) -> None:
    report = report_of(run, "compact", bare, "-o", tmp_path / "a.ply", "--quality", "22dB", "--effort", "fast")
    assert report["choices"]["search"]["met"]
    assert report["choices"]["search"]["psnr"] >= 22
    kept = report_of(run, "compact", bare, "-o", tmp_path / "b.ply", "--budget", "auto")
    assert kept["choices"]["fidelity"]["psnr"] >= 32.5


@pytest.mark.slow
def test_photos_without_cameras_change_no_byte_of_the_result(
    bare: Path, smallest_scene: Path, tmp_path: Path, run: Any
) -> None:
    """Neither those that are named nor those that lie beside the scene."""
    named, beside = smallest_scene / "images", Path(shutil.copytree(smallest_scene / "images", tmp_path / "images"))
    scene, quick = Path(shutil.copy(bare, tmp_path)), ("--budget", "20%", "--effort", "draft")
    run("compact", bare, *quick, "-o", tmp_path / "expected.ply", code=0)
    for photos, words in ((named, (bare, "--images", named)), (beside, (scene,))):
        report = report_of(run, "compact", *words, *quick, "-o", tmp_path / "a.ply", "--overwrite")
        assert sum(noted([note], photos, "not used", "no cameras", "transforms.json") for note in report["notes"]) == 1
        assert sum(noted([note], *PLACED) for note in report["notes"]) == 1
        assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()


def test_photos_are_used_with_order_none_where_cameras_are_known(
    smallest_scene: Path, tmp_path: Path, run: Any
) -> None:
    """Where the photos' sizes are the rows', their cameras are estimated, whatever the hint says of the order."""
    shutil.copy(smallest_scene / "scene.ply", tmp_path / "scene.ply")
    images = ("--images", smallest_scene / "images")
    quick = ("--effort", "draft", "--hint", "order=none")
    report = report_of(run, "compact", tmp_path / "scene.ply", *images, *quick, "-o", tmp_path / "a.ply")
    assert not noted(report["notes"], "not used")
    assert report["psnr_input_views"]["after"] is not None


@pytest.mark.slow
def test_draft_notes_that_it_has_no_fit(bare: Path, tmp_path: Path, run: Any) -> None:
    draft, fast = (
        report_of(run, "compact", bare, "-o", tmp_path / f"{effort}.ply", "--budget", "20%", "--effort", effort)
        for effort in ("draft", "fast")
    )
    assert noted(draft["notes"], "draft has no fit", "--effort fast")
    assert not noted(fast["notes"], "no fit")
    assert fast["choices"]["fidelity"]["psnr"] > draft["choices"]["fidelity"]["psnr"]


@pytest.mark.slow
def test_inspect_bounds_what_compact_writes(bare: Path, tmp_path: Path, run: Any) -> None:
    """A plan does not search, which is most of the run."""
    report = report_of(run, "compact", bare, "-o", tmp_path / "a.ply")
    count = report["output"]["num_gaussians"]
    plan = report_of(run, "inspect", bare)["compact"]
    assert plan["num_gaussians"] < count < plan["most_gaussians"] == report["input"]["num_gaussians"]
    assert not plan["exact"]
    assert report["choices"]["fidelity"]["psnr"] > 32.5
    assert noted(report["notes"], f"kept {count:,} of")
