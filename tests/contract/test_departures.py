"""The recipe departs from the paper as the page's table says, and nowhere else."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from network_fixtures import made, noisy, untrained

from gsmerge.arrays import as_array
from gsmerge.method.networks.apply import encode_features
from gsmerge.method.networks.checkpoint import IN_PACKAGE
from gsmerge.method.networks.corrections import residual_limits
from gsmerge.method.networks.options import ABSOLUTE_BOUNDS, GROUP_COLUMNS, NetworkOptions, weight_shapes
from gsmerge.method.stages.decode import decode
from gsmerge.method.stages.superpixels import segment
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.settings.compact import RECIPES
from gsmerge.settings.stages import DecodeOptions, SegmentOptions

PAGE = Path(__file__).parents[2] / "docs" / "results.md"
TITLE = "## Where the recipe departs from the paper"
CHECKPOINT = load_checkpoint(IN_PACKAGE["paper"])
OPTIONS = CHECKPOINT.networks.options
SMALL = replace(OPTIONS, width=16, heads=2, latent=8)
ALL = DecodeOptions(k=2, min_opacity=0.0)


def rows() -> list[list[str]]:
    """Return the rows of the page's table, without its head."""
    section = PAGE.read_text(encoding="utf-8").partition(f"{TITLE}\n")[2].partition("\n## ")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if "|" in line]
    return cells[2:]


def heads() -> None:
    """Check that silent heads leave round Gaussians as large as their group, and others move them within bounds."""
    scene = made()
    features = encode_features(scene.features, scene.networks(untrained(SMALL)))
    still = decode(features, scene.members, ALL, networks=scene.networks(untrained(SMALL)))
    sizes = scene.networks(untrained(SMALL)).describe(features).sizes
    np.testing.assert_allclose(still.scales, np.repeat(sizes, 2)[:, None].repeat(3, 1), rtol=1e-5)
    assert (still.opacities == 0.5).all()
    moved = decode(features, scene.members, ALL, networks=scene.networks(noisy(SMALL, 100.0)))
    limit = residual_limits(ABSOLUTE_BOUNDS)[3]
    assert 0.9 * limit < np.abs(np.log(as_array(moved.scales) / still.scales)).max() <= limit * 1.001


def group_numbers() -> None:
    """Check what is read besides tokens and latents."""
    shapes, width, latent = weight_shapes(OPTIONS), OPTIONS.width, OPTIONS.latent
    joined = {name: shapes[f"{name}.join.0.weight"][1] - width for name in ("encoder.set", "merger.set", "refiner")}
    assert joined == dict.fromkeys(joined, 22 + 4) == dict.fromkeys(joined, GROUP_COLUMNS)
    assert [shapes[f"heads.{k}.seeds.0.weight"][1] - latent for k in (1, 2, 4)] == [4, 4, 4]  # mass and base colour


def bass() -> None:
    """Check that a plain picture and a busy one get the same number of superpixels."""
    assert RECIPES["paper"]["segmentation"] == "bass-st"
    pictures = np.stack([np.full((60, 80, 3), 0.5), np.random.default_rng(0).random((60, 80, 3))]).astype(np.float32)
    options = SegmentOptions(segmentation="bass-st", superpixels=RECIPES["paper"]["superpixels"])
    assert segment(pictures, options).counts == (int(0.053 * 4800),) * 2


def siblings() -> None:
    """Check that the world's size has no influence on the loss, at most 1 times the photometric one."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from gsmerge.research.training.losses import diversity_loss
    from gsmerge.types import Gaussians

    generator, losses = torch.Generator().manual_seed(0), []
    scales, means = (torch.rand(40, 3, generator=generator) + 0.1 for _ in range(2))
    quats, opacities = torch.tensor([1.0, 0, 0, 0]).expand(40, 4), torch.rand(40, generator=generator)
    for unit in (1.0, 0.01):
        colors = torch.zeros(40, 1, 3), torch.zeros(40, 0, 3)
        gaussians = Gaussians(unit * means, quats, unit * scales, opacities, *colors)
        losses.append(float(diversity_loss(gaussians, torch.arange(40) // 4, torch.full((40,), unit))))
    assert 0 < losses[0] <= 1
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)


def harmonics() -> None:
    """Check that children have their group's harmonics."""
    scene = made()
    context = scene.networks(noisy(SMALL, 0.05))
    encoded = context.encode(scene.features)
    features = replace(encoded, shN=np.random.default_rng(0).normal(size=(len(encoded), 3, 3)).astype(np.float32))
    children = decode(features, scene.members, ALL, networks=context)
    assert np.array_equal(children.shN, features.shN.repeat(2, 0))


def training() -> None:
    """Check what the checkpoint that ships was trained with, and what ``--preset paper`` has instead."""
    pytest.importorskip("torch", reason="the package's training imports it")
    from gsmerge.research.training import preset_options

    facts, letter, short = CHECKPOINT.training, preset_options("paper"), preset_options("paper-shipped")
    assert facts["options"]["network"] == short.to_dict()["network"] == letter.to_dict()["network"]
    assert (letter.steps, letter.lpips_weight, letter.window, letter.photo_side) == (300_000, 0.05, 476, 476)
    trained = facts["options"]
    assert (trained["steps"], trained["lpips_weight"], trained["window"]) == (2600, 0.0, 192)
    assert trained["random_views"] == list(letter.random_views) == [1, 12]
    assert len(facts["data"]) + len(facts["validation"]) == 10 + 16


CHECKS: dict[str, Callable[[], None]] = {
    "heads": heads, "group numbers": group_numbers, "BASS": bass, "siblings": siblings, "harmonics": harmonics,
    "training": training,
}  # fmt: skip


def test_table_has_a_row_for_every_departure() -> None:
    assert [row[0] for row in rows()] == list(CHECKS)
    assert all(len(row) == 5 and all(row) for row in rows())


@pytest.mark.parametrize("name", CHECKS)
def test_recipe_departs_from_the_paper_as_the_table_says(name: str) -> None:
    CHECKS[name]()


def test_recipe_has_the_paper_s_values_besides_the_departures() -> None:
    """The recipe's settings, and those of its networks."""
    assert RECIPES["paper"] == {
        "superpixels": "5.3%", "segmentation": "bass-st", "match": "aabb", "fit": "none", "min_contribution": 0.0,
        "k_low": 100 / 3, "k_high": 200 / 3, "checkpoint": "paper", "require_checkpoint": True,
    }  # fmt: skip
    sizes = ("width", "heads", "blocks", "refine_blocks", "latent", "neighbors")  # which the paper leaves open
    letter = NetworkOptions(
        outputs="absolute", merger_start="first", geometry="carried", group_numbers=False, members=256
    )
    assert replace(letter, **{name: getattr(OPTIONS, name) for name in sizes}) == OPTIONS
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    for words in ("k = 1 nearest neighbour", "IoU of 0.2", "cosine of 0.8", "1/255", "256 members"):
        assert words in text, words
