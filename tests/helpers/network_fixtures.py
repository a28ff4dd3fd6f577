"""Networks with weights that do something, and Feature Gaussians of a made scene for them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scenes import arc, make_scene, room

from gsmerge.moments import Members, scene_members
from gsmerge.networks.apply import NetworkContext
from gsmerge.networks.checkpoint import save_checkpoint
from gsmerge.networks.options import NetworkOptions
from gsmerge.research.training.modules import Networks
from gsmerge.stages.encode import encode
from gsmerge.types import FeatureGaussians, Groups, Scene

SMALL = NetworkOptions(width=16, heads=2, latent=8, members=8, neighbors=4)


def noisy(options: NetworkOptions = SMALL, scale: float = 0.3, seed: int = 0) -> Networks:
    """Networks with random last layers too."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = Networks(options)
        for name, parameter in networks.named_parameters():
            if name.split(".")[-2] in ("out", "shift") and not bool(parameter.any()):
                torch.nn.init.normal_(parameter, std=scale)
    return networks.eval().requires_grad_(False)


def scaled(networks: Networks, factor: float) -> Networks:
    """The networks with every weight times a factor, in place."""
    for parameter in networks.parameters():
        parameter.data.mul_(factor)
    return networks


def written(path: Path, networks: Networks) -> Path:
    """A checkpoint of the networks."""
    save_checkpoint(path, networks.weights(), {"steps": 0})
    return path


@dataclass(frozen=True)
class Made:
    """A made scene, its members and analytic Feature Gaussians of groups of many sizes."""

    scene: Scene
    members: Members
    features: FeatureGaussians

    def networks(self, networks: Networks, seed: int = 0) -> NetworkContext:
        """The networks for this scene, as they are applied: without torch."""
        return NetworkContext(networks.weights(), self.members, self.scene.cameras, seed)


def made(num_views: int = 2) -> Made:
    """Groups of 1 to 40 members."""
    scene = make_scene(room(), arc(num_views, 24, 18))
    members = scene_members(scene)
    sizes = [1, 2, 3, 5, 8, 9, 13, 17, 30, 40]
    edges = np.cumsum(np.tile(sizes, 4))
    edges = edges[edges < 24 * 18]
    labels = np.searchsorted(edges, np.arange(24 * 18), side="right").reshape(18, 24).astype(np.int32)
    count = len(edges) + 1
    groups = Groups(np.stack([labels] * num_views), (count,) * num_views)
    return Made(scene, members, encode(scene, members, groups))
