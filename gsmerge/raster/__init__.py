"""Rendering: images of Gaussians, and the contribution of every Gaussian to them.

:func:`render` makes images, :func:`render_in_turn` more of them than fit into memory. The stages
that need more than images work per view: :func:`tile_view` projects, sorts and bins once;
:func:`composite`, :func:`splat_adjoint` and :func:`contributions` then walk the same lists with the
same blending weights. The conventions are gsplat's: 0.3 px dilation, alpha clamped at 0.99,
contributions below 1/255 cut, a pixel stops before its transmittance would reach 1e-4, pixel
centres at +0.5.

:func:`render` can be differentiated; the fit takes gradients from :mod:`gsmerge.raster.gradient`.

Results do not depend on the number of threads: every Gaussian is projected and every tile blended
alone, and what is summed over tiles is summed in the order of the tiles.
"""

from gsmerge.raster.composite import Rendering, composite, contributions, splat_adjoint
from gsmerge.raster.images import render, render_in_turn
from gsmerge.raster.tiled_view import Splats, TiledView, make_splats, tile_view

__all__ = [
    "Rendering",
    "Splats",
    "TiledView",
    "composite",
    "contributions",
    "make_splats",
    "render",
    "render_in_turn",
    "splat_adjoint",
    "tile_view",
]
