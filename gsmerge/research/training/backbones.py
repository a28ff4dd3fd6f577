"""Make examples from captures, which have no Gaussians: a backbone predicts them for each drawn subset of views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from threading import Lock
from typing import TypeVar

import numpy as np
import torch

from gsmerge.arrays import to_float32
from gsmerge.compaction.tensors import make_gaussians, make_scene
from gsmerge.io.cameras.camera_file import select_views
from gsmerge.measure.sizes import shrink_views
from gsmerge.research.captures import Capture
from gsmerge.research.training.examples import Example, draw_ids, make_example
from gsmerge.research.training.scenes import make_training_scene, view_subsets
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.scene.content_hash import digest
from gsmerge.types import Cameras, Gaussians, Scene, Views

Other = TypeVar("Other")
# Photos [v,h,w,3] sRGB in [0, 1] float32, and their cameras -> v h w Gaussians, view by view, in the cameras' world
Backbone = Callable[[np.ndarray, Cameras], Gaussians]
NOVEL_PHOTOS = 4  # photos of novel views in an example, drawn from all other photos, since there may be hundreds


@dataclass(frozen=True, eq=False)
class PredictedCapture:
    """A capture that makes a new example at every draw: other views, with Gaussians predicted from only these views."""

    capture: Capture
    backbone: Backbone

    @property
    def scene(self) -> str:
        """Name of the scene, valid as a file name."""
        return self.capture.name.replace("/", "-")

    @property
    def sha256(self) -> str:
        """Hash that identifies the capture when a run is resumed; it is of the name, since photos may be terabytes."""
        return digest({"capture": self.capture.name})

    def draw(self, options: TrainOptions, rng: np.random.Generator) -> Example:
        """Draw views and a density, predict the Gaussians of these views, and make the example.

        Raises SceneError if the capture cannot be read, or if the Gaussians do not lie in their pixels, and ValueError
        for a wrong number of Gaussians.
        """
        cameras = self.capture.read_cameras()
        if options.random_views:
            ids = draw_ids(len(cameras), options, rng)
        else:
            subsets = view_subsets(len(cameras), options.views)
            ids = subsets[int(rng.integers(len(subsets)))]
        others = np.setdiff1d(np.arange(len(cameras)), ids)
        novel = sorted(rng.choice(others, min(NOVEL_PHOTOS, len(others)), replace=False).tolist())
        density = options.densities[int(rng.integers(len(options.densities)))]
        views = self.capture.read_views(select_views(cameras, [*ids, *novel]))
        views = shrink_views(views, options.photo_side)
        given, held_out = views[range(len(ids))], views[range(len(ids), len(views))]
        scene = self._predict(given)
        training = make_training_scene(scene, range(len(scene)), held_out if novel else None)
        return replace(make_example(training, options, density, self.scene), drawn=True)

    def _predict(self, views: Views) -> Scene:
        predicted = self.backbone(views.images, views.cameras)
        expected = views.images[..., 0].size
        if len(predicted) != expected:
            sizes = " x ".join(map(str, views.images.shape[:3]))
            raise ValueError(f"backbone: expected {sizes} = {expected} Gaussians of {self.scene}, got {len(predicted)}")
        columns = {f.name: np.array(getattr(predicted, f.name)) for f in fields(Gaussians)}
        columns |= {name: to_float32(column) for name, column in columns.items() if name != "means"}
        gaussians, valid, _ = make_gaussians(columns)
        return make_scene(gaussians, valid, views.cameras, views.images, views.names, "view-major")[0]


def bind_backbone(examples: Sequence[Other | Capture], backbone: Backbone | None) -> list[Other | PredictedCapture]:
    """Give the captures among examples their backbone, which is called by one thread at a time, without gradients.

    Raises ValueError if there are captures but no backbone.
    """
    lock = Lock()

    def call(images: np.ndarray, cameras: Cameras) -> Gaussians:
        assert backbone is not None
        with lock, torch.no_grad():
            return backbone(images, cameras).numpy()

    captures = [example for example in examples if isinstance(example, Capture)]
    if captures and backbone is None:
        raise ValueError(f"backbone: expected a callable that predicts the Gaussians of {captures[0].name}, got none")
    return [PredictedCapture(example, call) if isinstance(example, Capture) else example for example in examples]
