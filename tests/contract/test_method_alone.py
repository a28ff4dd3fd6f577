"""The method can be taken alone: it makes Gaussians of arrays where nothing that knows files can be imported."""

from __future__ import annotations

import subprocess
import sys

LEFT = (
    "blocks", "cli", "counts", "drawing", "integrations", "io", "jobs", "plan", "plugin", "prepare", "reading",
    "research", "results", "run", "scoring",
)  # fmt: skip
CODE = f"""
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("gsmerge.") and name.split(".")[1] in {LEFT}:
            raise ImportError(f"{{name}} is no part of the method")

sys.meta_path.insert(0, Refuse())

import numpy as np
from gsmerge.method.facts.pictures import PHOTOS
from gsmerge.method.facts.prepared import Prepared, Reference
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.kernels.elementary import sin
from gsmerge.method.pipelines.bare_rows import BARE_ROWS
from gsmerge.method.pipelines.build import build
from gsmerge.method.pipelines.pixel_rows import PIXEL_ROWS
from gsmerge.method.pipelines.plan import CountPlan, MergePlan, Plan, ScorePlan
from gsmerge.method.stages.limits import CountLimits
from gsmerge.method.stages.segment import SuperpixelChoices
from gsmerge.settings.fit import FitOptions
from gsmerge.settings.stages import CleanOptions, DecodeOptions, MatchOptions, SegmentOptions
from gsmerge.types import Cameras, Gaussians, PicturedScene, Pixels, Scene

# Two views of a wall with a step in its depth and a pattern, and a Gaussian for each pixel
VIEWS, HEIGHT, WIDTH = 2, 24, 32
K = np.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])
y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
depth = np.where(x < 14, 2.0, 3.0)
images = np.zeros((VIEWS, HEIGHT, WIDTH, 3), np.float32)
means = np.zeros((VIEWS, HEIGHT, WIDTH, 3), np.float32)
viewmats = np.tile(np.eye(4), (VIEWS, 1, 1))
for view in range(VIEWS):
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    points = rays * depth[..., None] + [0.1 * view, 0, 0]
    viewmats[view, 0, 3] = -0.1 * view
    means[view] = points
    images[view] = 0.5 + 0.4 * sin(4 * points)
num = VIEWS * HEIGHT * WIDTH
gaussians = Gaussians(
    means=means.reshape(num, 3), quats=np.tile(np.float32([1, 0, 0, 0]), (num, 1)),
    scales=np.repeat((means[..., 2] / 40).reshape(num, 1), 3, 1), opacities=np.full(num, 0.9, np.float32),
    sh0=rgb_to_sh0(images.reshape(num, 1, 3)), shN=np.zeros((num, 0, 3), np.float32),
)
cameras = Cameras(viewmats, np.tile(K, (VIEWS, 1, 1)), WIDTH, HEIGHT)
pixels = Pixels.of_grid(np.ones(images.shape[:3], bool))
scene = Scene(gaussians, cameras, names=("0", "1"), images=images, pixels=pixels)

canonical, frame = canonicalise(PicturedScene.with_pictures(scene, images, None))
prepared = Prepared(scene, canonical, frame, Reference(PHOTOS, (0, 1)), repeated=(0, 1), moved=False)

for pipeline in (PIXEL_ROWS, BARE_ROWS):
    limits = CountLimits(
        per_view=60, default=120, min_count=2, max_count=num, exact=None, num_pixels=num, num_input=num, most=num
    )
    plan = Plan(
        count=CountPlan(limits, target_psnr=None, keeps_fidelity=False, max_drop=None, auto_count=False, levels=1),
        merge=MergePlan(SuperpixelChoices(SegmentOptions(superpixels=60)), MatchOptions("overlap"), DecodeOptions(k=1)),
        fit=FitOptions(fit_steps=20, photo_scale=1.0),
        score=ScorePlan(output="", new_views=False),
        clean=CleanOptions(), pipeline=pipeline, seed=0, settings={{}},
    )
    fitted = build(prepared, plan, count=100)
    print(len(prepared.frame.leave(fitted.gaussians)))
"""


def test_the_method_makes_gaussians_of_arrays_where_nothing_that_knows_files_can_be_imported() -> None:
    out = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout
    counts = [int(line) for line in out.split()]
    assert len(counts) == 2
    assert all(50 <= count <= 100 for count in counts)
