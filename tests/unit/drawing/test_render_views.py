"""Pictures of a scene do not depend on its unit, and empty pictures are named with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from messages import says

import gsmerge
from gsmerge import Cameras, DoubtWarning, Gaussians
from gsmerge.drawing.render_views import doubt_empty


@pytest.fixture(scope="module")
def scene() -> gsmerge.Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 48, 32))


def in_unit(scene: gsmerge.Scene, unit: float) -> tuple[Gaussians, Cameras]:
    """Return the scene with lengths times ``unit``."""
    viewmats = scene.cameras.viewmats.astype(np.float64)
    viewmats[:, :3, 3] *= unit
    gaussians = replace(scene.gaussians, means=scene.gaussians.means * unit, scales=scene.gaussians.scales * unit)
    return gaussians, replace(scene.cameras, viewmats=viewmats)


@pytest.mark.parametrize("unit", [2.0**-10, 2.0**10])
def test_pictures_are_the_same_in_any_unit(scene: gsmerge.Scene, unit: float) -> None:
    one, other = (gsmerge.render(*in_unit(scene, each)).images for each in (1.0, unit))
    np.testing.assert_allclose(one, other, atol=1e-5)


def test_a_near_plane_is_what_the_caller_says(scene: gsmerge.Scene) -> None:
    gaussians, cameras = in_unit(scene, 2.0**-10)
    with pytest.warns(DoubtWarning, match=r"picture 0, picture 1, picture 2, .* near plane, 0\.01"):
        drawn = gsmerge.render(gaussians, cameras, near=0.01)
    assert not drawn.alphas.any()


@pytest.mark.parametrize(("change", "reason"), [
    (lambda g: g[:0], "it has none"),
    (lambda g: replace(g, opacities=g.opacities * 0), "all are transparent"),
    (lambda g: replace(g, means=g.means - np.float32([0, 0, 1e3])), "all lie behind the camera"),
    (lambda g: replace(g, means=g.means + np.float32([1e4, 0, 0])), "beside the picture"),
])  # fmt: skip
def test_an_empty_picture_has_its_reason(scene: gsmerge.Scene, change: object, reason: str) -> None:
    assert callable(change)
    camera = scene.cameras[[0]]
    assert doubt_empty(scene.gaussians, camera, 0.01, ["left"]) == []
    (doubt,) = doubt_empty(change(scene.gaussians), camera, 0.01, ["left"])
    assert doubt.names == ("left",)
    assert says(doubt, "", "left", reason)
