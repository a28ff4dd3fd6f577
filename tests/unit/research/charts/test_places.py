"""Scenes of a grid as files: their names, their targets, and what their hash depends on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsmerge.errors import SceneError, UsageError
from gsmerge.research.charts.experiment import Experiment
from gsmerge.research.charts.proxies import (
    SEGMENTATIONS,
    SHARES,
    measure_proxies,
    proxy_points,
    proxy_psnr,
    read_proxies,
)
from gsmerge.research.charts.run import RunOptions, estimate_seconds
from gsmerge.research.charts.scenes import SceneSource, find_scenes, scene_names


def test_names_are_as_short_as_can_be() -> None:
    assert scene_names([Path("a/room"), Path("b/fern.ply")]) == ["room", "fern"]
    assert scene_names([Path("a/scene.ply"), Path("b/scene.ply")]) == ["a/scene", "b/scene"]
    assert scene_names([]) == []
    assert scene_names([Path("room.1"), Path("room.2")]) == ["room.1", "room.2"]
    with pytest.raises(UsageError, match="every scene once"):
        scene_names([Path("a"), Path("./a")])


def test_targets_are_one_file_or_a_template(scene_copy: Path) -> None:
    ply = scene_copy / "scene.ply"
    for scene, template in (
        (scene_copy, "{scene}/targets/transforms.json"),
        (ply, "{parent}/targets/transforms.json"),
        (scene_copy, "{parent}/targets/transforms.json"),
        (ply, str(scene_copy / "targets" / "transforms.json")),
    ):
        (place,) = find_scenes([scene], template)
        assert place.targets == scene_copy / "targets" / "transforms.json"
        assert place.num_views == 5
    (named,) = find_scenes([ply], "{parent}/{stem}.ply")
    assert named.targets == ply
    (scene_copy / "transforms.json").write_text("{")  # an error when the scene is read
    assert find_scenes([scene_copy])[0].num_views is None
    with pytest.raises(SceneError, match="expected cameras of held-out views"):
        find_scenes([scene_copy], "{scene}/nothing.json")
    for template in ("{}/targets", "{scene.foo}/targets", "{stem[foo]}", "{"):
        with pytest.raises(UsageError, match="in braces"):
            find_scenes([scene_copy], template)


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("scene.ply", True),
        ("transforms.json", True),
        ("images/view_000.png", True),
        ("targets/transforms.json", True),
        ("targets/images/view_000.png", True),
        ("notes.txt", False),
    ],
)
def test_the_hash_knows_all_that_is_read(name: str, counts: bool, scene_copy: Path) -> None:
    def sha256() -> str:
        return find_scenes([scene_copy], "{scene}/targets/transforms.json")[0].sha256

    before = sha256()
    assert before == sha256()
    path = scene_copy / name
    path.write_bytes((path.read_bytes() if path.exists() else b"") + b" ")
    assert (sha256() != before) is counts


def test_results_beside_targets_do_not_count(scene_copy: Path) -> None:
    before = find_scenes([scene_copy], "{scene}/targets")[0].sha256
    (scene_copy / "targets" / "charts").mkdir()
    (scene_copy / "targets" / "charts" / "runs.jsonl").write_text("{}")
    assert find_scenes([scene_copy], "{scene}/targets")[0].sha256 == before
    (scene_copy / "targets" / "transforms.json").write_text("{}")
    assert find_scenes([scene_copy], "{scene}/targets")[0].sha256 != before


def test_a_copy_has_the_same_hash(scene_copy: Path, made_scene: Path) -> None:
    assert find_scenes([scene_copy])[0].sha256 == find_scenes([made_scene])[0].sha256


def estimate(place: SceneSource, **options: object) -> float:
    method = str(options.pop("method", "gsmerge"))
    experiment = Experiment(place.path, method, options.pop("settings", {}), options.pop("views", None))  # type: ignore[arg-type]
    return estimate_seconds([("key", experiment, place)], {}, RunOptions(threads=2, **options))  # type: ignore[arg-type]


def test_estimates_grow_with_the_work(made_scene: Path) -> None:
    (place,) = find_scenes([made_scene])
    usual = estimate(place)
    assert estimate(place, settings={"fit": "none"}) < usual < estimate(place, settings={"effort": "best"})
    assert estimate(place, views=2) < usual < estimate(place, lpips=("vgg",))
    assert usual < estimate(place, lpips=("vgg",), lpips_views=1) < estimate(place, lpips=("vgg",))
    costs = [estimate(place, method=name) for name in ("random", "greedy", "unmerged-fit")]
    assert costs == sorted(costs)


def test_proxies_of_other_kinds_of_values_are_passed_over(tmp_path: Path) -> None:
    good = {
        "key": "a",
        "scene": "room",
        "segmentation": "slic",
        "superpixels": 9,
        "share": 0.1,
        "views": 1,
        "psnr": 20.0,
    }
    lines = [good, good | {"key": "b", "psnr": "20"}, good | {"key": "c", "scene": None}, {"key": "d"}]
    (tmp_path / "proxies.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert list(read_proxies(tmp_path)[0]) == ["a"]


def test_proxies_fill_superpixels_with_their_means(made_scene: Path, tmp_path: Path) -> None:
    import gsmerge

    images = gsmerge.read_scene(made_scene).images
    assert images is not None
    coarse, fine = (proxy_psnr(images[0], count, "rdseg") for count in (20, 600))
    assert 10 < coarse < fine - 3
    expected = proxy_points("ab" * 32, 2)
    assert len(expected) == len(SEGMENTATIONS) * len(SHARES)
    some = {key: point for key, point in expected.items() if point in (("rdseg", 0.01), ("slic", 0.01))}
    done: list[int] = []
    measure_proxies(tmp_path, "room", images, some, max_views=2, progress=lambda: done.append(1))
    actual, notes = read_proxies(tmp_path)
    assert (set(actual), notes, len(done)) == (set(some), (), 2)
    rdseg, slic = (next(p for p in actual.values() if p.segmentation == name) for name in ("rdseg", "slic"))
    assert rdseg.psnr > slic.psnr
    assert (rdseg.superpixels, rdseg.views) == (61, 2)
