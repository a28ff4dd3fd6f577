"""Results of the superpixel merging paper's method and of what it is compared with, made once and scored once."""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from networks import Store, silenced
from shared_scenes import export

import gsmerge
from gsmerge.facts.views import pick_views
from gsmerge.measure.evaluate import EvaluateOptions, evaluate, near_plane
from gsmerge.measure.lpips import lpips
from gsmerge.measure.sizes import shrink_cameras, shrink_views
from gsmerge.measure.visibility import context_points, visible_pixels
from gsmerge.research.charts.measure_run import choose_views
from gsmerge.scene.files import find_scene_files
from gsmerge.scene.held_out import HeldOutViews, read_held_out
from gsmerge.scene.read import load_files
from gsmerge.types import Gaussians, Views

PHOTO_SIDE = 476  # pixels on the longer side, as in the paper
LPIPS_VIEWS = 2
COUNTS = (3, 6, 9, 12)
SIZES = ("2.2%", "5.3%", "10.2%")  # the paper's 5, 12 and 23 thousand superpixels of 476 x 476 pixels
USUAL = "5.3%"
Runs = dict[str, dict[str, Any]]  # by scene


@dataclass(frozen=True)
class Way:
    """A way to make a result.

    Args:
        name: In the tables.
        settings: Of ``compact``; None: the input as it is.
        key: Of the paper's printed figures.
        networks: The file that it depends on: "paper", or "" for none.
        silent: Networks whose last layers are set to zero.
        equal: Whether it has as many Gaussians as ``recipe=paper`` with K = 1.
    """

    name: str
    settings: dict[str, Any] | None
    key: str = ""
    networks: str = ""
    silent: str | None = None
    equal: bool = False


@dataclass(frozen=True)
class Case:
    """What a result is made of: an exporter's style, number of views (None: all), superpixels."""

    style: str = "plain"
    views: int | None = None
    size: str = USUAL


def recipe(name: str, key: str = "", silent: str | None = None, **settings: Any) -> Way:
    """The paper's method with some settings."""
    return Way(name, {"recipe": "paper", **settings}, key, "paper", silent)


INPUT = Way("the input", None, "input")
WHOLE = recipe("the recipe, K = 1", "k1", k=1)
CHILDREN = tuple(recipe(f"K = {k}", f"k{k}", k=k) for k in (2, 4))
MIXED = recipe("mixed K, by thirds", "mixed", k="mixed")
MOMENTS = Way("`moment-matching`", {"method": "moment-matching"}, "moments", equal=True)
FIT = Way("the defaults", {}, equal=True)
VARIANTS = (
    recipe("no merging across views", k=1, match="none"),
    recipe("the 8 nearest neighbours instead of one", k=1, neighbors=8),
    recipe("the encoder's latents zero", silent="latent", k=1),
    *(recipe(f"without the {name}", silent=name, k=1) for name in ("merger", "refiner", "heads")),
)
RESIZED = {"2.2%": "larger superpixels", "10.2%": "smaller superpixels"}
PLAIN, STYLES = Case(), ("da3", "depthsplat", "anysplat")
VIEW_WAYS = (INPUT, MOMENTS, WHOLE, *CHILDREN, MIXED, FIT)
STYLE_WAYS = (INPUT, MOMENTS, WHOLE, CHILDREN[1], FIT)


@dataclass
class Bench:
    """All scenes, and where their runs are kept."""

    folders: list[Path]
    store: Store
    cache: Path
    files: dict[str, Path]  # of networks
    lpips: bool
    spent: float = 0.0  # processor seconds of this process
    digests: dict[str, str] = field(default_factory=dict)

    def run(self, folder: Path, way: Way, case: Case) -> dict[str, Any]:
        """The run of a way on a scene: a finished one, or a new one, which is kept."""
        settings = None if way.settings is None else dict(way.settings)
        if settings is not None and way.equal:
            settings["budget"] = self.run(folder, WHOLE, case)["count"]
        elif settings is not None and case.size != USUAL:
            settings["superpixels"] = case.size
        count = case.views or num_views(folder)
        what = [folder.name, case.style, count, settings, way.silent, self.digest(way.networks), self.lpips]
        key = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:24]
        if key not in self.store.runs:
            start = time.process_time()
            figures = self.measure(folder, way, case, settings)
            spent = time.process_time() - start
            self.spent += spent
            head = {"scene": folder.name, "name": way.name, "case": [case.style, count, case.size]}
            one = {"key": key, **head, "settings": settings, **figures, "processor": spent}
            print(json.dumps(one), file=sys.stderr, flush=True)
            self.store.add(one)
        return self.store.runs[key]

    def digest(self, networks: str) -> str:
        """The hash of a file of networks; empty for none."""
        if networks and networks not in self.digests:
            content = self.files[networks].read_bytes()
            self.digests[networks] = hashlib.sha256(content).hexdigest()[:16]
        return self.digests.get(networks, "")

    def measure(self, folder: Path, way: Way, case: Case, settings: dict[str, Any] | None) -> dict[str, Any]:
        """Make a result and score it."""
        ply = export(folder, self.cache, case.style)
        scene, targets = read_case(folder, ply, case.views)
        images = dict[int, np.ndarray]()
        gaussians, facts = scene.gaussians, dict[str, Any]()
        if settings is not None:
            gaussians, facts = self.compact(scene, way, settings)
        options = EvaluateOptions((), context=False, own=False, photo_side=PHOTO_SIDE, fog=False)
        scores = evaluate(
            scene, {"it": gaussians}, targets, options,
            on_image=lambda _, __, view, image: images.update({view: image}),
        ).results[0]  # fmt: skip
        visible = scores.mean("target")[1]
        seen = [visible.psnr, visible.ssim]
        if self.lpips:
            seen.append(distance(scene, targets, images))
        return {"count": len(gaussians), "ratio": scores.ratio, "seen": seen, **facts}

    def compact(self, scene: gsmerge.Scene, way: Way, settings: dict[str, Any]) -> tuple[Gaussians, dict[str, Any]]:
        """A way's Gaussians, and the share of groups that is left after matching."""
        with tempfile.TemporaryDirectory() as place:
            if way.networks:
                file = self.files[way.networks]
                file = silenced(file, way.silent, Path(place)) if way.silent else file
                settings = {**settings, "checkpoint": str(file)}
            result = gsmerge.compact(scene, **settings)
        choices = result.report.choices
        matched = choices["clusters"] / choices["groups"] if "clusters" in choices else 1.0
        return result.gaussians, {"matched": matched}

    @property
    def counts(self) -> list[int]:
        """The numbers of views that any scene has."""
        return [count for count in COUNTS if any(num_views(folder) >= count for folder in self.folders)]

    def runs(self, way: Way, case: Case) -> Runs:
        """The runs of the scenes that have so many views."""
        folders = [folder for folder in self.folders if num_views(folder) >= (case.views or 0)]
        return {folder.name: self.run(folder, way, case) for folder in folders}


@cache
def num_views(folder: Path) -> int:
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    return sum(frame["role"] == "context" for frame in frames)


@lru_cache(maxsize=1)
def load_case(folder: Path, ply: Path) -> tuple[gsmerge.Scene, HeldOutViews]:
    """A scene, and its held-out views in the world of the export."""
    load = load_files(find_scene_files(ply))
    return load.scene, read_held_out(load, folder / "transforms.json")


@lru_cache(maxsize=2)
def read_case(folder: Path, ply: Path, views: int | None) -> tuple[gsmerge.Scene, Views]:
    """Some views of a scene, and the held-out ones between them at the paper's size."""
    scene, targets = choose_views(*load_case(folder, ply), views)
    assert targets is not None
    return scene, shrink_views(targets, PHOTO_SIDE)


def distance(scene: gsmerge.Scene, targets: Views, images: Mapping[int, np.ndarray]) -> float:
    """LPIPS of the visible pixels of two views; ``evaluate`` takes twice as long, as it has more of them."""
    near = near_plane(scene)
    chosen = pick_views(len(targets.names), LPIPS_VIEWS)
    sources = scene.cameras if scene.has_own_pixels else shrink_cameras(scene.cameras, PHOTO_SIDE)
    masks = visible_pixels(context_points(scene, near, sources), targets.cameras[chosen], near, sources)
    pairs = zip(chosen, targets.images[chosen], masks, strict=True)
    return float(np.mean([lpips(images[i], photo, "vgg", mask) for i, photo, mask in pairs]))
