"""Scene -> the sizes on which a plan depends."""

from __future__ import annotations

from functools import reduce

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import median, quantiles
from gsmerge.method.geometry.views import camera_kinds
from gsmerge.types import Gaussians, Scene

# Limits that the Gaussians of every real capture keep. The median of the Gaussians' largest scales is at most
# LARGE_SCALE times the diagonal of the box that holds most Gaussians. The median coefficient of the base colours is at
# most BRIGHT_COLOR. The limits are not tested on fewer than FEWEST_TESTED Gaussians
LARGE_SCALE = 0.25
BRIGHT_COLOR = 10.0
FEWEST_TESTED = 100
# least range of the base colours' coefficients; least median opacity
FLAT_RANGE = 0.01
FAINT_MEDIAN = 1 / 255


@dataclass(frozen=True)
class SceneSize:
    """Sizes of a scene that a plan depends on, known before the scene is read in full."""

    num_gaussians: int
    num_views: int
    height: int  # Pixels
    width: int
    has_own_pixels: bool  # True if each Gaussian belongs to one view
    # True if renders of the input stand in for photos, because there are no photos and views share the Gaussians
    rendered: bool
    num_cameras: int = 2  # Number of different cameras; 1: all views have the same camera
    sh_degree: int = 0

    @property
    def pixels_per_view(self) -> int:
        """Pixels of each view."""
        return self.height * self.width


def measure_size(scene: Scene, rendered: bool | None = None) -> SceneSize:
    """Return the sizes of a scene.

    ``rendered`` is the field of :class:`SceneSize`. If ``rendered`` is None, photos are assumed to show the scene.
    """
    cameras = scene.cameras.numpy()  # Gaussians on a GPU stay there, because only their number is needed
    return SceneSize(
        num_gaussians=scene.num_gaussians,
        num_views=len(scene),
        height=cameras.height,
        width=cameras.width,
        has_own_pixels=scene.has_own_pixels,
        rendered=not scene.is_shown if rendered is None else rendered,
        num_cameras=1 + int(camera_kinds(cameras).max()) if len(scene) else 0,
        sh_degree=scene.gaussians.sh_degree,
    )


def unlike_captures(gaussians: Gaussians) -> str | None:
    """Say in one sentence how finite Gaussians differ from those of real captures; None if they do not differ.

    The bounds are in docs/reference/conventions.md.
    """
    if len(gaussians) < FEWEST_TESTED:
        return None
    sample_gaussians = 65536  # the bounds are tested on at least this many Gaussians, if there are as many
    sample = gaussians[:: max(1, len(gaussians) // sample_gaussians)]
    means = sample.means.astype(np.float64)
    low, high = quantiles(means, (0.01, 0.99))
    diagonal = float(np.sqrt(((high - low) ** 2).sum()))
    size = median(reduce(np.maximum, sample.scales.T))
    color = median(np.abs(sample.sh0))
    low_color, high_color = quantiles(sample.sh0[:, 0], (0.01, 0.99))
    flat = float((high_color - low_color).max()) < FLAT_RANGE
    faint = median(sample.opacities) < FAINT_MEDIAN
    if color > BRIGHT_COLOR:
        problem = f"half of the base colours have coefficients beyond {color:.3g}"
    elif flat:
        problem = "the Gaussians have one flat colour"
    elif faint:
        problem = f"half of the opacities are below {FAINT_MEDIAN:.2g}"
    elif size > LARGE_SCALE * diagonal:
        problem = f"half of the Gaussians are at least {size / max(diagonal, 1e-30):.2g} times as large as the scene"
    else:
        return None
    return f"{problem}, unlike in any capture; the file may store them in another way; nothing is scored"
