"""Networks have weights that do something, and a made scene has Feature Gaussians for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scenes import arc, make_scene, room

from gsmerge.method.geometry.pooling import Members, scene_members
from gsmerge.method.networks.apply import NetworkContext
from gsmerge.method.networks.options import NetworkOptions, weight_shapes
from gsmerge.method.networks.weights import NetworkWeights
from gsmerge.method.stages.encode import encode
from gsmerge.reading.checkpoint import save_checkpoint
from gsmerge.types import FeatureGaussians, Groups, Scene

SMALL = NetworkOptions(width=16, heads=2, latent=8, members=8, neighbors=4)
LAST = ("out", "shift")  # layers that begin as zeros; that of latents does not


def noisy(options: NetworkOptions = SMALL, scale: float = 0.3, seed: int = 0) -> NetworkWeights:
    """Return networks of random weights, with last layers of that deviation: before training they are zero."""
    rng, arrays, inputs = np.random.default_rng(seed), dict[str, np.ndarray](), 1.0
    for name, shape in weight_shapes(options).items():
        layer, kind = name.split(".")[-2:]
        if kind == "weight":
            inputs = shape[1] if len(shape) == 2 else np.inf  # of a norm, which begins with ones and zeros
        if layer in LAST and "attention" not in name:
            array = scale * rng.normal(size=shape)
        elif kind == "seed":
            array = rng.normal(size=shape) / shape[-1] ** 0.5
        else:
            array = np.ones(shape) if (kind, inputs) == ("weight", np.inf) else rng.uniform(-1, 1, shape) / inputs**0.5
        arrays[name] = array.astype(np.float32)
    return NetworkWeights(options, arrays)


def untrained(options: NetworkOptions | None = None) -> NetworkWeights:
    """Return networks that correct nothing, as before training."""
    return noisy(options or NetworkOptions(), 0.0)


def scaled(networks: NetworkWeights, factor: float) -> NetworkWeights:
    """Return the networks with every weight times a factor."""
    return replace(networks, arrays={name: array * np.float32(factor) for name, array in networks.arrays.items()})


def written(path: Path, networks: NetworkWeights) -> Path:
    """Write a checkpoint of the networks, and return its path."""
    save_checkpoint(path, networks, {"steps": 0})
    return path


@dataclass(frozen=True)
class Made:
    """A made scene, its members and analytic Feature Gaussians of groups of many sizes."""

    scene: Scene
    members: Members
    features: FeatureGaussians

    def networks(self, networks: NetworkWeights, seed: int = 0) -> NetworkContext:
        """Return the networks for this scene."""
        return NetworkContext(networks, self.members, self.scene.cameras, seed)


def made(num_views: int = 2) -> Made:
    """Make groups of 1 to 40 members."""
    scene = make_scene(room(), arc(num_views, 24, 18))
    members = scene_members(scene)
    sizes = [1, 2, 3, 5, 8, 9, 13, 17, 30, 40]
    edges = np.cumsum(np.tile(sizes, 4))
    edges = edges[edges < 24 * 18]
    labels = np.searchsorted(edges, np.arange(24 * 18), side="right").reshape(18, 24).astype(np.int32)
    count = len(edges) + 1
    groups = Groups(np.stack([labels] * num_views), (count,) * num_views)
    return Made(scene, members, encode(scene, members, groups))
