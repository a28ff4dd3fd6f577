"""Files sorted by opacity: rows in no order, made on the rays of their pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import Smooth, da3_rows, export_rows, save_export, smooth_scene, turned
from messages import noted
from sweeps import sweep
from tiny_scene import Tiny, make_tiny, rotation

from gsmerge.alignment.incomplete import read_unordered
from gsmerge.alignment.ordered_rows import ProjectedRows
from gsmerge.geometry import IDENTITY
from gsmerge.scene.read import load_scene
from gsmerge.types import SH_C0, Cameras

MANY_OR_FEW = [3, pytest.param(8, marks=pytest.mark.slow)]  # views


def scene_on_rays(views: int, jitter: float = 0.0, size: tuple[int, int] = (64, 48)) -> Tiny:
    """Views of a waved surface from an arc, each Gaussian within ``jitter`` pixels of its pixel's centre."""
    width, height = size
    tiny, rng = make_tiny(width, height), np.random.default_rng(11)
    y, x = np.mgrid[:height, :width] + 0.5
    c2w, means, images = np.tile(np.eye(4), (views, 1, 1)), [], []
    for i, turn in enumerate(np.linspace(-0.4, 0.4, views)):
        c2w[i, :3, :3] = rotation(0.1 * turn + 0.03, -turn, 0.2 * turn)
        c2w[i, :3, 3] = (2.5 * turn, 0.3 * turn**2, 0.4 * abs(turn))
        depth = 3 + 0.4 * np.sin(x / 8 + i) * np.cos(y / 6)
        pixels = np.stack([x, y, np.ones_like(x)], -1)
        pixels[..., :2] += rng.uniform(-jitter, jitter, (height, width, 2))
        world = (pixels @ np.linalg.inv(tiny.K).T * depth[..., None]).reshape(-1, 3) @ c2w[i, :3, :3].T + c2w[i, :3, 3]
        color = 0.5 + 0.4 * np.sin(5 * world + np.array([0, 1, 2]))
        means.append(world)
        images.append((color * 255).round().astype(np.uint8).reshape(height, width, 3))
    n = views * width * height
    gaussians = replace(
        tiny.gaussians[np.arange(n) % len(tiny.gaussians)],
        means=np.concatenate(means).astype(np.float32),
        opacities=rng.permutation(np.linspace(0.02, 0.99, n)).astype(np.float32),
        sh0=((np.stack(images).reshape(n, 1, 3) / 255.0).astype(np.float32) - 0.5) / SH_C0,
    )
    names = tuple(f"{i:02d}.png" for i in range(views))
    return replace(tiny, c2w=c2w, images=np.stack(images), gaussians=gaussians, names=names)


def by_opacity(tiny: Tiny, dropped: float) -> np.ndarray:
    """Grid rows from the most opaque on, without the least opaque ones."""
    opacities = tiny.gaussians.opacities
    return np.argsort(-opacities)[: round(len(opacities) * (1 - dropped))]


def share_at_home(actual: object, tiny: Tiny, kept: np.ndarray) -> float:
    """Share of the file's rows that are at the pixel they were made for."""
    at = np.full(len(kept), -1)
    layout = actual.recovery.best.layout  # type: ignore[attr-defined]
    for view, rows, pixels in zip(layout.views, layout.rows, layout.pixels, strict=True):
        at[rows] = view * tiny.width * tiny.height + pixels
    return float((at == kept).mean())


@pytest.mark.parametrize("photos", [True, False])
@pytest.mark.parametrize("views", MANY_OR_FEW)
@pytest.mark.parametrize("dropped", [0.0, 0.3, 0.6])
def test_rows_sorted_by_opacity_come_to_their_pixels(tmp_path: Path, views: int, dropped: float, photos: bool) -> None:
    tiny = scene_on_rays(views)
    kept = by_opacity(tiny, dropped)
    folder = save_export(tmp_path, tiny, export_rows(tiny, kept))
    if not photos:
        for name in tiny.names:
            (folder / "images" / name).unlink()
        (folder / "images").rmdir()
    loaded = load_scene(folder)
    assert share_at_home(loaded, tiny, kept) >= 0.99
    assert loaded.recovery.best.layout.order == "unordered"
    assert [d.name for d in loaded.exporters] == ["vicasplat"]
    assert noted(loaded.notes, "order")
    scene = loaded.pixel_scene()
    assert scene.num_gaussians == len(kept)


def test_colours_decide_between_near_views() -> None:
    """Two hundredths of a pixel off, eight views: some rows are nearer to a centre of another view."""
    tiny = scene_on_rays(8, 0.02)
    tiny = replace(tiny, images=np.random.default_rng(0).integers(0, 256, tiny.images.shape, np.uint8))
    kept = by_opacity(tiny, 0.2)
    points, base = tiny.gaussians.means.astype(np.float64)[kept], tiny.images.reshape(-1, 3)[kept] / 255
    photos = tiny.images.reshape(8, -1, 3) / 255
    cameras = Cameras(tiny.w2c, np.tile(tiny.K, (8, 1, 1)), tiny.width, tiny.height)
    projected = ProjectedRows(points, np.arange(len(points)), cameras)
    wrong = []
    for color_of in (None, lambda rows, view, pixels: np.abs(base[rows] - photos[view, pixels]).mean(1)):
        layout = read_unordered(projected, color_of=color_of)
        at = np.full(len(kept), -1)
        for view, rows, pixels in zip(layout.views, layout.rows, layout.pixels, strict=True):
            at[rows] = view * tiny.width * tiny.height + pixels
        wrong.append(float((at != kept).mean()))
    assert wrong[1] < 0.25 * wrong[0]
    assert wrong[1] < 0.002


def test_a_turned_world(tmp_path: Path) -> None:
    tiny = scene_on_rays(3)
    kept = by_opacity(tiny, 0.3)
    loaded = load_scene(save_export(tmp_path, tiny, turned(export_rows(tiny, kept), tiny.w2c[0, :3, :3])))
    assert loaded.recovery.best.frame.kind == "first"
    assert share_at_home(loaded, tiny, kept) >= 0.99


@pytest.mark.parametrize("views", MANY_OR_FEW)
@pytest.mark.parametrize("jitter", [0.25, 0.5])
def test_rows_anywhere_in_their_pixels_stay_unaligned(tmp_path: Path, views: int, jitter: float) -> None:
    tiny = scene_on_rays(views, jitter)
    folder = save_export(tmp_path, tiny, export_rows(tiny, by_opacity(tiny, 0.3)))
    for order in ("auto", "unordered"):
        assert not load_scene(folder, order=order).scene.aligned


@pytest.mark.slow
def test_many_views_make_chance(tmp_path: Path) -> None:
    """Sixty views: most rows are within a twentieth of a pixel of some view's centre."""
    tiny = scene_on_rays(60, 0.5, (32, 24))
    folder = save_export(tmp_path, tiny, export_rows(tiny, by_opacity(tiny, 0.5)))
    assert not load_scene(folder, exporter="vicasplat").scene.aligned


def test_the_given_order_and_exporter(tmp_path: Path) -> None:
    tiny = scene_on_rays(3)
    kept = by_opacity(tiny, 0.3)
    rows = export_rows(tiny, kept, rest=45, normals="u1")
    folder = save_export(tmp_path, tiny, rows)
    for hints in ({"order": "unordered"}, {"exporter": "longlrm-sorted"}, {"scene_scale": 1.0}):
        loaded = load_scene(folder, **hints)
        assert share_at_home(loaded, tiny, kept) >= 0.99
        assert [d.name for d in loaded.exporters] == ["longlrm-sorted"]
    assert loaded.recovery.best.frame.scale == IDENTITY.scale
    assert not load_scene(folder, order="view-major").scene.aligned


def test_rows_without_finite_positions(tmp_path: Path) -> None:
    tiny = scene_on_rays(3)
    kept = by_opacity(tiny, 0.3)
    rows = export_rows(tiny, kept)
    rows["x"][[0, 5, 700]] = np.nan
    loaded = load_scene(save_export(tmp_path, tiny, rows))
    finite = np.isfinite(rows["x"])
    assert share_at_home(loaded, tiny, kept) >= 0.99 * finite.mean()
    assert int(loaded.pixel_scene().stored.sum()) >= 0.99 * finite.sum()


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])  # in the order of the file, and not
def test_two_views_of_one_pose(tmp_path: Path, names: tuple[str, str]) -> None:
    one = scene_on_rays(1)
    twice = replace(
        one,
        c2w=one.c2w.repeat(2, 0),
        images=one.images.repeat(2, 0),
        gaussians=one.gaussians[np.tile(np.arange(len(one.gaussians)), 2)],
        names=[f"images/{name}.png" for name in names],
    )
    twice.save(tmp_path)
    loaded = load_scene(tmp_path)
    assert loaded.scene.aligned
    assert len(loaded.scene) == 2


@pytest.fixture(scope="module")
def smooth() -> Smooth:
    return smooth_scene(48, 36)


def view_fastest(smooth: Smooth, dropped: float, seed: int = 0) -> np.ndarray:
    """Grid rows by pixel, then view, without a share of them."""
    cells = smooth.height * smooth.width
    every = np.arange(3 * cells).reshape(3, cells).T.reshape(-1)
    return every[np.random.default_rng(seed).random(len(every)) >= dropped]


@pytest.mark.parametrize("dropped", [0.1, 0.4])
def test_nearly_every_row_comes_to_its_pixel(tmp_path: Path, smooth: Smooth, dropped: float) -> None:
    """All but one in a hundred: in pictures so small, two views can see a row equally near to where it should be."""
    kept = view_fastest(smooth, dropped)
    loaded = load_scene(save_export(tmp_path, smooth, export_rows(smooth, kept)))
    scene = loaded.pixel_scene()
    assert loaded.recovery.best.layout.order == "view-fastest"
    actual = np.flatnonzero(scene.stored.reshape(-1))
    wrong = np.setxor1d(actual, kept)
    assert len(wrong) <= 0.02 * len(kept)  # a row in a wrong place is missing in another
    same = np.intersect1d(actual, kept)
    right = np.abs((scene.gaussians.opacities - smooth.gaussians.opacities)[same]) < 1e-5
    assert float(right.mean()) > 0.985
    assert any("view-fastest" in note for note in loaded.notes)


@pytest.mark.parametrize("nested", [0.4, 1.7])
def test_rows_pixel_by_pixel_at_another_scale(tmp_path: Path, nested: float) -> None:
    """The scale is where projections gather at the centres of pixels, which no order is needed for."""
    tiny = smooth_scene(96, 72)
    kept = view_fastest(tiny, 0.3)
    c2w = tiny.c2w.copy()
    c2w[:, :3, 3] *= nested
    loaded = load_scene(save_export(tmp_path, replace(tiny, c2w=c2w), export_rows(tiny, kept)))
    assert loaded.recovery.best.layout.order == "view-fastest"
    assert loaded.recovery.best.frame.scale == pytest.approx(1 / nested, rel=1e-3)
    actual = loaded.recovery.best.layout.pixel_ids(len(kept))
    assert np.mean(actual == kept) > 0.985


@sweep("size", [(96, 72), (64, 48)])
@pytest.mark.parametrize("dropped", [0.1, 0.3, 0.4, "faint", "far"])
@sweep("nested", [0.4, 1.0, 1.3])
def test_dropped_pixels(tmp_path: Path, nested: float, dropped: float | str, size: tuple[int, int]) -> None:
    """At random, or by a rule; in the frame of the cameras, or in another scale, which can put rows near to others."""
    tiny = smooth_scene(*size)
    if dropped == "far":
        kept = da3_rows(tiny)
    elif dropped == "faint":
        kept = np.flatnonzero(tiny.gaussians.opacities > 0.1)
    else:
        kept = np.flatnonzero(np.random.default_rng(3).random(len(tiny.gaussians)) > float(dropped))
    c2w = tiny.c2w.copy()
    c2w[:, :3, 3] *= nested
    loaded = load_scene(save_export(tmp_path, replace(tiny, c2w=c2w), export_rows(tiny, kept)))
    assert loaded.recovery.best.layout.kind == "pruned"
    assert loaded.recovery.best.frame.scale == pytest.approx(1 / nested, rel=2e-3)
    scene = loaded.pixel_scene()
    assert np.mean(np.flatnonzero(scene.stored.reshape(-1)) == kept) > 0.99
    right = np.abs((scene.gaussians.opacities - tiny.gaussians.opacities)[scene.stored.reshape(-1)]) < 1e-5
    assert float(right.mean()) > 0.99


def test_a_scale_that_cannot_be_measured_is_not_guessed(tmp_path: Path) -> None:
    """Gaussians anywhere in their pixels: of several scales that fit as well, none is taken."""
    tiny, rng = smooth_scene(64, 48), np.random.default_rng(2)
    means = tiny.gaussians.means + rng.normal(0, 0.02, tiny.gaussians.means.shape).astype(np.float32)
    tiny = replace(tiny, gaussians=replace(tiny.gaussians, means=means))
    c2w = tiny.c2w.copy()
    c2w[:, :3, 3] *= 1.5
    kept = np.flatnonzero(rng.random(len(means)) > 0.4)
    folder = save_export(tmp_path, replace(tiny, c2w=c2w), export_rows(tiny, kept))
    assert not load_scene(folder, order="view-major").scene.aligned
