from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, replace

import pytest
import torch

from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Groups, PixelScene


def gaussians(n: int, coefficients: int = 0, start: int = 0) -> Gaussians:
    row = torch.arange(start, start + n, dtype=torch.float32)
    return Gaussians(
        row[:, None].expand(n, 3), row[:, None].expand(n, 4), row[:, None].expand(n, 3), row,
        row[:, None, None].expand(n, 1, 3), row[:, None, None].expand(n, coefficients, 3),
    )  # fmt: skip


def cameras(c: int = 2) -> Cameras:
    return Cameras(torch.eye(4, dtype=torch.float64).repeat(c, 1, 1), torch.eye(3).repeat(c, 1, 1).double(), 4, 3)


def features(sizes: list[int]) -> FeatureGaussians:
    g = len(sizes)
    column = torch.arange(g, dtype=torch.float32)
    starts = torch.tensor([0, *torch.tensor(sizes).cumsum(0).tolist()])
    return FeatureGaussians(
        means=column[:, None].expand(g, 3), covars=column[:, None, None].expand(g, 3, 3), weights=column, masses=column,
        extinctions=column, gains=column, spreads=column, sh0=torch.zeros(g, 1, 3), shN=torch.zeros(g, 0, 3),
        footprints=column, views=column.long(), backing=torch.zeros(g, dtype=torch.bool), starts=starts,
        members=torch.arange(int(starts[-1])), latents=torch.zeros(g, 0),
    )  # fmt: skip


def test_gaussians_are_indexed_by_row() -> None:
    g = gaussians(5, 3)
    assert len(g) == 5
    assert g[1:3].means[:, 0].tolist() == [1, 2]
    assert g[torch.tensor([4, 0])].opacities.tolist() == [4, 0]
    assert g[g.opacities > 2].shN.shape == (2, 3, 3)
    assert len(g[:0]) == 0


def test_gaussians_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        gaussians(1).means = torch.zeros(1, 3)  # type: ignore[misc]


@pytest.mark.parametrize(("coefficients", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3), (24, 4)])
def test_degree(coefficients: int, degree: int) -> None:
    assert gaussians(2, coefficients).sh_degree == degree


def test_concat_keeps_the_order() -> None:
    both = Gaussians.concat([gaussians(2, 3), gaussians(3, 3, start=2)])
    for f in fields(Gaussians):
        assert torch.equal(getattr(both, f.name), getattr(gaussians(5, 3), f.name))


def test_to_keeps_everything() -> None:
    g = gaussians(2).to("cpu")
    assert torch.equal(g.means, gaussians(2).means)
    assert cameras().to("cpu").width == 4


@pytest.mark.parametrize(
    ("name", "shape"),
    [("means", (5, 2)), ("quats", (5, 3)), ("scales", (4, 3)), ("opacities", (5, 1)), ("sh0", (5, 3)), ("shN", (5, 3))],
)
def test_wrong_shapes_are_named(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected shape .* got "):
        replace(gaussians(5), **{name: torch.zeros(shape)})


def test_incomplete_harmonics_are_refused() -> None:
    with pytest.raises(ValueError, match="expected 0, 3, 8, 15 or 24 coefficients, got 5"):
        gaussians(2, 5)


def test_cameras() -> None:
    c = cameras(3)
    assert len(c) == 3
    assert len(c[:1]) == 1
    assert (c[1:].width, c[1:].height) == (4, 3)
    viewmat = torch.tensor([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]], dtype=torch.float64)
    assert replace(c, viewmats=viewmat.expand(3, 4, 4)).centres[0].tolist() == [7, -6, -5]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": torch.eye(3).expand(2, 3, 3)}, "viewmats: expected shape"),
        ({"Ks": torch.eye(3).expand(1, 3, 3)}, "Ks: expected shape"),
        ({"width": 0}, "expected a positive image size, got 0 x 3"),
        ({"height": -1}, "expected a positive image size"),
    ],
)
def test_wrong_cameras_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(cameras(), **change)


def scene() -> PixelScene:
    return PixelScene(gaussians(24), cameras(), torch.zeros(2, 3, 4, 3), torch.ones(2, 3, 4).bool(), ("a", "b"))


def test_scene() -> None:
    assert len(scene()) == 2
    assert scene().pixels_per_view == 12
    assert replace(scene(), images=None).images is None


def test_what_the_file_has() -> None:
    assert scene().num_missing == 0
    assert len(scene().file_gaussians) == scene().num_gaussians == 24
    missing = torch.zeros(2, 3, 4).bool()
    missing[1, 2, 3] = missing[0, 0, 1] = True
    some = replace(scene(), missing=missing)
    assert (some.num_missing, some.num_gaussians, int(some.stored.sum())) == (2, 22, 22)
    assert torch.equal(some.file_gaussians.means, torch.cat([gaussians(24).means[:1], gaussians(24).means[2:23]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gaussians": gaussians(23)}, "expected 2 x 3 x 4 = 24 Gaussians, got 23"),
        ({"valid": torch.ones(2, 4, 3).bool()}, "valid: expected shape"),
        ({"images": torch.zeros(2, 3, 4, 4)}, "images: expected shape"),
        ({"names": ("a",)}, "expected 2 view names, got 1"),
        ({"missing": torch.ones(2, 4, 3).bool()}, "missing: expected shape"),
    ],
)
def test_wrong_scenes_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(scene(), **change)


def test_groups_count_all_views() -> None:
    assert len(Groups(torch.zeros(2, 3, 4, dtype=torch.int32), (3, 4))) == 7
    with pytest.raises(ValueError, match="labels: expected shape"):
        Groups(torch.zeros(2, 3, 4, dtype=torch.int32), (3,))


def test_features_concat_shifts_the_starts() -> None:
    both = FeatureGaussians.concat([features([2, 1]), features([3])])
    assert len(both) == 3
    assert both.starts.tolist() == [0, 2, 3, 6]
    assert both.members.tolist() == [0, 1, 2, 0, 1, 2]
    assert both.weights.tolist() == [0, 1, 0]


@pytest.mark.parametrize("name", ["weights", "masses", "extinctions", "gains", "spreads", "footprints", "starts"])
def test_wrong_features_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected shape"):
        replace(features([1, 2]), **{name: torch.zeros(7)})
