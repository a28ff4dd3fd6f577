"""Scene -> the sizes of it that decide a plan."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.facts.views import camera_kinds
from gsmerge.types import Scene


@dataclass(frozen=True)
class SceneSize:
    """Sizes of a scene that a plan depends on, known before the scene is read in full."""

    num_gaussians: int  # without rows that stand in for missing ones
    num_views: int
    height: int  # pixels
    width: int
    aligned: bool  # whether each Gaussian belongs to a pixel
    photos: bool  # whether there are photos to fit to, or what stands in for them
    drawn: bool = False  # whether that is drawings of the scene itself
    num_cameras: int = 2  # views at different places; 1: one camera took all
    sh_degree: int = 0

    @property
    def rendered(self) -> bool:
        """Whether results are measured against renders of the input, for lack of photos and of pixels."""
        return self.drawn or not (self.photos or self.aligned)

    @property
    def pixels_per_view(self) -> int:
        """Pixels of each view."""
        return self.height * self.width


def measure_size(scene: Scene, *, photos: bool | None = None, drawn: bool | None = None) -> SceneSize:
    """Return the sizes of a scene.

    ``photos``, ``drawn``: see :class:`SceneSize`; None: as they are before photos are compared with the Gaussians.
    """
    if drawn is None:
        drawn = len(scene) > 0 and not scene.is_shown
    cameras = scene.cameras.numpy()  # the Gaussians may stay on a GPU: only their number counts
    return SceneSize(
        scene.num_gaussians, len(scene), cameras.height, cameras.width, scene.aligned,
        photos=scene.is_shown or drawn if photos is None else photos, drawn=drawn,
        num_cameras=1 + int(camera_kinds(cameras).max()) if len(scene) else 0,
        sh_degree=scene.gaussians.sh_degree,
    )  # fmt: skip
