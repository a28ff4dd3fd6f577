"""Train on captures without Gaussians: a frozen backbone predicts those of drawn views, from these views alone.

This is how the paper trains: 1 to 12 views of a capture are drawn, the backbone makes Gaussians of them, and windows of
other photos of the capture show how well the merged Gaussians serve new views.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np
import torch

from gsmerge.frozen import dataclass, field
from gsmerge.research.training.examples import Example, draw_random_views, make_example
from gsmerge.research.training.scenes import make_training_scene
from gsmerge.research.training.shards import Shard, hash_arrays
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.types import Cameras, Gaussians, Pixels, Scene, Views

# Photos [v,h,w,3], sRGB in [0, 1], and their cameras -> v·h·w Gaussians, view by view, in the world of the cameras
Backbone = Callable[[np.ndarray, Cameras], Gaussians]
# views that are drawn, as in the paper
FEWEST_VIEWS = 1
MOST_VIEWS = 12
NOVEL_PHOTOS = 4  # photos of other views beside those that are drawn, since a capture may have hundreds


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos with cameras, and the backbone that predicts their Gaussians.

    The backbone is called by one thread at a time, without gradients. Photos and cameras have the size at which the
    backbone sees them.
    """

    views: Views
    backbone: Backbone
    scene: str = "capture"  # name of the scene
    lock: Lock = field(default_factory=Lock, repr=False)

    @property
    def sha256(self) -> str:
        """Hash of photos and cameras, which identifies the capture when a run is resumed."""
        cameras = self.views.cameras
        arrays = {"images": self.views.images, "viewmats": cameras.viewmats, "Ks": cameras.Ks}
        return hash_arrays({name: np.ascontiguousarray(array) for name, array in arrays.items()})

    def draw(self, options: TrainOptions, rng: np.random.Generator) -> Example:
        """Draw views and a density, predict the Gaussians of these views, and make the example.

        Raises ValueError if the backbone returns another number of Gaussians than one for each pixel.
        """
        num_views = len(self.views)
        least, most = (min(count, num_views) for count in options.random_views or (FEWEST_VIEWS, MOST_VIEWS))
        order = rng.permutation(num_views)
        count = int(rng.integers(least, most + 1))
        ids = sorted(order[:count].tolist())
        others = sorted(order[count : count + NOVEL_PHOTOS].tolist())
        density = options.densities[int(rng.integers(len(options.densities)))]
        given = self.views.cameras[ids]
        images = np.asarray(self.views.images)
        with self.lock, torch.no_grad():
            predicted = self.backbone(images[ids], given).numpy()
        shape = count, given.height, given.width
        if len(predicted) != np.prod(shape):
            raise ValueError(f"backbone: expected {np.prod(shape):,} Gaussians, one for each pixel of {count} views of"
                f" {self.scene}, got {len(predicted):,}")  # fmt: skip
        names = tuple(self.views.names[view] for view in ids)
        scene = Scene(predicted, given, images[ids], Pixels.of_grid(np.ones(shape, bool)), names)
        novel = Views(self.views.cameras[others], images[others], tuple(self.views.names[view] for view in others))
        training = make_training_scene(scene, range(count), novel if others else None)
        return make_example(training, options, density, self.scene)


def draw_example(
    source: Shard | Capture, options: TrainOptions, rng: np.random.Generator, read: Callable[[Shard], Example]
) -> Example:
    """Draw views of a stored example, which ``read`` returns, or of a capture, whose Gaussians are predicted."""
    if isinstance(source, Capture):
        return source.draw(options, rng)
    return draw_random_views(read(source), options, rng)
