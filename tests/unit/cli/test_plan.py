"""What ``--dry-run`` says of a scene before it is worked on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsmerge import Cameras, CompactOptions, Gaussians, Scene
from gsmerge.cli.plan import plan_document, plan_lines
from gsmerge.io import SceneFiles
from gsmerge.types import grid_ids

HEIGHT, WIDTH = 100, 200


def plan(*, photos: bool = True, views: int = 12, **settings: Any) -> dict[str, Any]:
    shape = (views, HEIGHT, WIDTH)
    n = views * HEIGHT * WIDTH
    sizes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, 0, 3))
    scene = Scene(
        gaussians=Gaussians(*(np.zeros(size, np.float32) for size in sizes)),
        cameras=Cameras(np.tile(np.eye(4), (views, 1, 1)), np.tile(np.eye(3), (views, 1, 1)), WIDTH, HEIGHT),
        images=np.zeros((*shape, 3), np.float32) if photos else None,
        pixel_ids=grid_ids(np.ones(shape, bool)),
        names=tuple(map(str, range(views))),
    )
    options = CompactOptions().with_settings({"superpixels": 800, "threads": 2} | settings)
    files = SceneFiles(Path("scene.ply"), Path("transforms.json"), None)
    return plan_document(files, scene, options, Path("small.ply"), [])


def test_plan_counts() -> None:
    assert plan(k=2)["output"]["num_gaussians_at_most"] == 12 * 800 * 2
    assert plan(views=1, k=8)["output"]["num_gaussians_at_most"] == 6400
    assert plan()["input"]["num_gaussians"] == 240_000
    assert plan(budget="auto")["output"]["num_gaussians_at_most"] == 12 * 800


def test_plan_knows_that_more_gaussians_take_more_steps() -> None:
    few, many, asked = (plan(**s)["estimate"] for s in ({}, {"budget": "20%"}, {"budget": "20%", "fit_steps": 240}))
    assert few == asked
    assert many["seconds"] > 1.2 * few["seconds"]


def test_plan_says_where_adaptive_superpixels_start() -> None:
    adaptive = {"segmentation": "bass-adaptive"}
    assert any("800 per view at the start, 1" in line for line in plan_lines(plan(**adaptive, superpixels="4%")))
    assert any("800 per view, 1" in line for line in plan_lines(plan(**adaptive)))
    assert any("800 per view, 1" in line for line in plan_lines(plan(superpixels="4%")))


def test_plan_of_a_budget() -> None:
    document = plan(budget="2%")
    assert document["output"]["num_gaussians_at_most"] == 4800
    assert document["superpixels_per_view"] is None
    assert any("at most 4,800" in line for line in plan_lines(document))
    assert all(plan_lines(plan(budget="auto")))


def test_plan_says_what_will_not_run() -> None:
    assert plan()["fit"] == "full"
    assert plan(fit="none")["fit"] == "none"
    assert plan(photos=False)["fit"] == "none"


def test_plan_of_less_work_takes_less() -> None:
    full, lean = plan()["estimate"], plan(fit="none")["estimate"]
    assert lean["seconds"] < full["seconds"]
    assert plan(photos=False)["estimate"]["memory_bytes"] < full["memory_bytes"]
    assert all(line for line in plan_lines(plan()))
