"""Scene -> the sizes of it that decide a plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsmerge.facts.views import camera_kinds
from gsmerge.types import Gaussians, Scene

# Of Gaussians that captures have: median largest scale as a share of twice the median distance from the middle, which
# a far sky does not stretch, and of the diagonal of the box that holds most; median coefficient of the base colours; of
# fewer nothing is said
TINY, LARGE, BRIGHT, FEWEST = 1e-6, 0.25, 10.0, 100
DENSE = 0.5  # Gaussians for each pixel
FLAT, FAINT = 0.01, 1 / 255  # range of the base colours' coefficients, and median opacity, at least
SAMPLE_GAUSSIANS = 65536  # Gaussians that these are measured on
Pictures = Literal["photos", "renders"]  # photos or what stands in for them; drawings of the scene itself


@dataclass(frozen=True)
class SceneSize:
    """Sizes of a scene that a plan depends on, known before the scene is read in full."""

    num_gaussians: int
    num_views: int
    height: int  # pixels
    width: int
    has_own_pixels: bool  # whether each view has Gaussians of its own
    pictures: Pictures  # what results are fitted to
    num_cameras: int = 2  # views at different places; 1: one camera took all
    sh_degree: int = 0

    @property
    def rendered(self) -> bool:
        """Whether results are measured against renders of the input, for lack of photos and of pixels."""
        return self.pictures == "renders"

    @property
    def pixels_per_view(self) -> int:
        """Pixels of each view."""
        return self.height * self.width

    @property
    def is_dense(self) -> bool:
        """Whether there are about as many Gaussians as pixels, so that a share of them is enough to show these."""
        return self.has_own_pixels or self.num_gaussians >= DENSE * self.num_views * self.pixels_per_view > 0


def measure_size(scene: Scene, pictures: Pictures | None = None) -> SceneSize:
    """Return the sizes of a scene; ``pictures`` None: as they are before photos are compared with the Gaussians."""
    if pictures is None:
        pictures = "photos" if scene.is_shown else "renders"
    cameras = scene.cameras.numpy()  # the Gaussians may stay on a GPU: only their number counts
    return SceneSize(
        scene.num_gaussians, len(scene), cameras.height, cameras.width, scene.has_own_pixels, pictures,
        num_cameras=1 + int(camera_kinds(cameras).max()) if len(scene) else 0,
        sh_degree=scene.gaussians.sh_degree,
    )  # fmt: skip


def unlike_captures(gaussians: Gaussians) -> str | None:
    """Say in which way finite Gaussians are as those of no capture, in one sentence; None where nothing is odd.

    Bounds are in docs/reference/conventions.md.
    """
    if len(gaussians) < FEWEST:
        return None
    sample = gaussians[:: max(1, len(gaussians) // SAMPLE_GAUSSIANS)]
    means = sample.means.astype(np.float64)
    low, middle, high = np.percentile(means, (1, 50, 99), axis=0)
    diagonal = float(np.sqrt(((high - low) ** 2).sum()))
    extent = 2 * float(np.median(np.sqrt(((means - middle) ** 2).sum(1))))
    size, color = float(np.median(sample.scales.max(1))), float(np.median(np.abs(sample.sh0)))
    low_color, high_color = np.percentile(sample.sh0[:, 0], (1, 99), axis=0)
    flat, faint = float((high_color - low_color).max()) < FLAT, float(np.median(sample.opacities)) < FAINT
    if color > BRIGHT:
        problem = f"half of the base colours have coefficients beyond {color:.3g}"
    elif flat:
        problem = "the Gaussians have one flat colour"
    elif faint:
        problem = f"half of the opacities are below {FAINT:.2g}"
    elif size < TINY * extent:
        problem = f"half of the Gaussians are at most {size / extent:.2g} times as large as the scene"
    elif size > LARGE * diagonal:
        problem = f"half of the Gaussians are at least {size / max(diagonal, 1e-30):.2g} times as large as the scene"
    else:
        return None
    return f"{problem}, as in no capture: are they stored otherwise? nothing is scored"
