"""Buildings: every view is what all of the building gives, and the walk is one that a person could take."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from sweeps import sweep

from gsmerge import Cameras
from gsmerge.research.generate import GenerateOptions, SyntheticScene, make_scene
from gsmerge.research.generate.floor_plan import EYE, WALL, draw_plan, draw_walk
from gsmerge.research.generate.folders import _write_views
from gsmerge.research.generate.photograph import (
    FAR,
    LitScene,
    Pinhole,
    find_windows,
    radiance,
    trace_scene,
)
from gsmerge.research.generate.shapes import LYING, axis_rotation
from gsmerge.research.generate.synthetic_scene import _find_building, _held_out
from gsmerge.runtime.threads import use_threads

LENS = Pinhole(40, 30, 26.0)
LARGE, LARGE_VIEWS = 7, 112  # a seed, and as many views as two storeys take


@dataclass(frozen=True)
class Built:
    """A building, and camera to world of all its views and held-out views."""

    scene: LitScene
    poses: list[np.ndarray]

    @property
    def whole(self) -> LitScene:
        """The same without knowledge of what hides what."""
        return replace(self.scene, portals=())


def built(seed: int, views: int) -> Built:
    scene, pose = _find_building(np.random.default_rng(seed), Pinhole(80, 60, 52.0), views)
    return Built(scene, [pose(s) for s in np.linspace(0, 1, 2 * views - 1)])


@pytest.fixture(scope="module")
def large() -> Built:
    """Two storeys of two rooms. Read only."""
    return built(LARGE, LARGE_VIEWS)


def world_points(depth: np.ndarray, c2w: np.ndarray, lens: Pinhole) -> np.ndarray:
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    rays = np.stack([(x - lens.width / 2) / lens.focal, (y - lens.height / 2) / lens.focal, np.ones_like(x)], -1)
    return c2w[:3, 3] + (rays * depth[..., None]) @ c2w[:3, :3].T


def home(scene: LitScene, c2w: np.ndarray) -> int | None:
    """The zone that a camera is in, or None in a doorway."""
    eye = c2w[:3, 3]
    inside = [k for k, zone in enumerate(scene.zones) if (eye > zone.low).all() and (eye < zone.high).all()]
    return inside[0] if inside else None


def test_a_view_is_what_all_shapes_give(large: Built) -> None:
    shares = []
    for pose in large.poses[::6]:
        given, all_given = trace_scene(large.scene, pose, LENS, 1)[0], trace_scene(large.whole, pose, LENS, 1)[0]
        np.testing.assert_array_equal(given.depth, all_given.depth)
        np.testing.assert_array_equal(given.normals, all_given.normals)
        assert given.depth.max() < FAR
        shares.append(len(find_windows(large.scene, pose, LENS, 1)) / len(large.scene.stages))
    for pose in large.poses[::40]:
        np.testing.assert_array_equal(radiance(large.scene, pose, LENS, 2), radiance(large.whole, pose, LENS, 2))
    assert np.mean(shares) < 0.6


def test_a_room_is_left_through_its_doors_alone(large: Built) -> None:
    """Whatever a camera sees outside its zone, it sees through an opening of the zone."""
    outside = 0
    for pose in large.poses[::5]:
        zone = home(large.scene, pose)
        if zone is None:
            continue
        low, high = large.scene.zones[zone].low, large.scene.zones[zone].high
        eye, points = pose[:3, 3], world_points(trace_scene(large.whole, pose, LENS, 1)[0].depth, pose, LENS)
        points = points.reshape(-1, 3)
        points = points[((points < low - WALL / 2) | (points > high + WALL / 2)).any(1)]
        rays = points - eye
        with np.errstate(divide="ignore"):
            leaves = np.where(rays > 0, (high - eye) / rays, np.where(rays < 0, (low - eye) / rays, np.inf)).min(1)
        crossings = eye + rays * leaves[:, None]
        doors = [p for p in large.scene.portals if zone in p.zones]
        through = np.array([((crossings > p.low) & (crossings < p.high)).all(1) for p in doors]).any(0)
        assert through.all()
        outside += len(points)
    assert outside > 1000


def test_rooms_see_little_of_one_another(large: Built) -> None:
    first_room = large.scene.portals[-1].zones[1] - 3
    shares = []
    for pose in large.poses[::5]:
        zone = home(large.scene, pose)
        if zone is None or zone < first_room:
            continue
        points = world_points(trace_scene(large.whole, pose, LENS, 1)[0].depth, pose, LENS).reshape(-1, 3)
        others = [z for k, z in enumerate(large.scene.zones) if k >= first_room and k != zone]
        shares.append(sum(((points > z.low) & (points < z.high)).all(1).mean() for z in others))
    assert np.mean(shares) < 0.03
    assert max(shares) < 0.3


@sweep(("seed", "views"), [(LARGE, LARGE_VIEWS), (0, 3), (1, 30), (2, 60), (3, 90)])
def test_the_walk_keeps_clear_of_everything(seed: int, views: int) -> None:
    case = built(seed, views)
    cube, faces = Pinhole(16, 16, 8.0), [np.eye(3), axis_rotation(0, np.pi / 2), axis_rotation(0, -np.pi / 2)]
    faces += [axis_rotation(1, angle) for angle in (np.pi / 2, np.pi, -np.pi / 2)]
    for pose in case.poses[::3]:
        for face in faces:
            around = np.eye(4)
            around[:3, :3], around[:3, 3] = face, pose[:3, 3]
            hits = trace_scene(case.whole if views < 10 else case.scene, around, cube, 1)[0]
            away = world_points(hits.depth, around, cube) - pose[:3, 3]
            assert np.linalg.norm(away, axis=-1).min() > 0.25
    moves = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in itertools.pairwise(case.poses)]
    assert max(moves) < 0.6


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("views", [60, 84, 252, 1000])
def test_the_walk_enters_every_room(seed: int, views: int) -> None:
    rng = np.random.default_rng(seed)
    plan = draw_plan(rng, views)
    walk = draw_walk(rng, plan, views)
    places = np.array([walk(s)[0] for s in np.linspace(0, 1, views)])
    assert len(plan.rooms) == views // 28
    for room in plan.rooms:
        local = (places - room.at) @ room.rotation
        inside = (np.abs(local[:, 0]) < room.width / 2) & (local[:, 2] > 0) & (local[:, 2] < room.depth)
        assert (inside & (np.abs(local[:, 1] + EYE) < 0.3)).sum() >= 8


def test_neighbours_see_common_surfaces(large: Built) -> None:
    shares = []
    views = large.poses[::2]
    for a, b in itertools.pairwise(views):
        points = world_points(trace_scene(large.scene, a, LENS, 1)[0].depth, a, LENS).reshape(-1, 3)
        depth = trace_scene(large.scene, b, LENS, 1)[0].depth
        local = (points - b[:3, 3]) @ b[:3, :3]
        ahead = local[:, 2] > 0.1
        at = local[ahead, :2] / local[ahead, 2:] * LENS.focal + [LENS.width / 2, LENS.height / 2]
        inside = ((at >= 0) & (at < [LENS.width, LENS.height])).all(1)
        x, y = at[inside].astype(int).T
        near = np.abs(depth[y, x] / local[ahead, 2][inside] - 1) < 0.1
        shares.append(near.sum() / len(points))
    assert np.mean(shares) > 0.5
    assert min(shares) > 0.15


def test_rooms_look_different(large: Built) -> None:
    papers = [
        {s.material.texture for s in room.stage.shapes if s.shell and not s.glow and (s.rotation != LYING).any()}
        for room in large.scene.stages[-4:]
    ]
    assert all(papers)
    assert sum(map(len, papers)) == len(set.union(*papers))


@pytest.fixture(scope="module")
def small() -> SyntheticScene:
    """A building of few views. Read only."""
    with use_threads(2):
        return make_scene(4, 1, GenerateOptions(views=(5, 5), width=48, height=36, style="building"))


def test_few_views_see_a_corridor_and_a_room(small: SyntheticScene) -> None:
    assert (small.style, small.path, len(small.cameras), len(small.target_images)) == ("building", "walk", 5, 4)
    two = make_scene(0, 0, GenerateOptions(views=(2, 2), width=16, height=16, style="building", path="walk"))
    assert len(two.target_images) == 1


def test_any_number_of_threads_makes_the_same_bits(small: SyntheticScene) -> None:
    with use_threads(1):
        again = make_scene(4, 1, GenerateOptions(views=(5, 5), width=48, height=36, style="building"))
    np.testing.assert_array_equal(again.gaussians.means, small.gaussians.means)
    np.testing.assert_array_equal(np.array(again.target_images), np.array(small.target_images))


def test_held_out_views_are_spread_evenly() -> None:
    assert _held_out(6, 50) == [1, 3, 5, 7, 9]
    for views in (52, 60, 252, 1000):
        places = np.array(_held_out(views, 50))
        assert len(set(places)) == 50
        assert (places % 2 == 1).all()
        assert 0 < places.min() < places.max() < 2 * views - 2
        assert np.ptp(np.diff(places)) <= 2


def test_a_building_has_a_walk_of_its_own() -> None:
    with refuses(ValueError, "path", "walk", "'orbit'"):
        GenerateOptions(style="building", path="orbit")
    with refuses(ValueError, "views", "2 to 2000", 2001):
        GenerateOptions(views=(2, 2001))


def test_more_than_a_thousand_views_keep_their_order(tmp_path: Path) -> None:
    cameras = Cameras(np.repeat(np.eye(4)[None], 1001, 0), np.repeat(np.eye(3)[None], 1001, 0), 2, 2)
    _write_views(tmp_path, cameras, [np.zeros((2, 2, 3), np.float32)] * 1001)
    names = sorted(path.name for path in (tmp_path / "images").iterdir())
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert (names[0], names[-1]) == ("view_0000.png", "view_1000.png")
    assert [frame["file_path"] for frame in frames] == [f"images/{name}" for name in names]
