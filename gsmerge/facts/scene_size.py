"""Scene -> the sizes of it that decide a plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsmerge.facts.views import camera_kinds
from gsmerge.types import Scene

Pictures = Literal["photos", "renders", "none"]  # photos or what stands in for them; drawings of the scene itself


@dataclass(frozen=True)
class SceneSize:
    """Sizes of a scene that a plan depends on, known before the scene is read in full."""

    num_gaussians: int  # without rows that stand in for missing ones
    num_views: int
    height: int  # pixels
    width: int
    aligned: bool  # whether each Gaussian belongs to a pixel
    pictures: Pictures  # what results are fitted to
    num_cameras: int = 2  # views at different places; 1: one camera took all
    sh_degree: int = 0

    @property
    def fitted(self) -> bool:
        """Whether there are pictures to fit to."""
        return self.pictures != "none"

    @property
    def rendered(self) -> bool:
        """Whether results are measured against renders of the input, for lack of photos and of pixels."""
        return self.pictures == "renders" or not (self.fitted or self.aligned)

    @property
    def pixels_per_view(self) -> int:
        """Pixels of each view."""
        return self.height * self.width


def measure_size(scene: Scene, pictures: Pictures | None = None) -> SceneSize:
    """Return the sizes of a scene; ``pictures`` None: as they are before photos are compared with the Gaussians."""
    if pictures is None:
        pictures = "photos" if scene.is_shown else "renders" if len(scene) else "none"
    cameras = scene.cameras.numpy()  # the Gaussians may stay on a GPU: only their number counts
    return SceneSize(
        scene.num_gaussians, len(scene), cameras.height, cameras.width, scene.aligned, pictures,
        num_cameras=1 + int(camera_kinds(cameras).max()) if len(scene) else 0,
        sh_degree=scene.gaussians.sh_degree,
    )  # fmt: skip
