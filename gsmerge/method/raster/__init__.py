"""Render images of Gaussians, and measure the contribution of every Gaussian to them.

:func:`render` makes images. :func:`render_in_batches` makes more images than fit into memory. Stages that need more
than images work on one view at a time: :func:`tile_view` projects, sorts and bins the Gaussians once, and
:func:`composite`, :func:`splat_adjoint` and :func:`contributions` then use the same tile lists with the same blending
weights. Cameras, Gaussians and images follow the conventions of gsplat. The dilation is 0.3 square pixels. Alpha is
clamped at 0.99, and contributions below 1/255 are cut. Blending of a pixel stops before its transmittance would reach
1e-4. Pixel centres are at +0.5.

:func:`render` can be differentiated. The fit takes gradients from :mod:`gsmerge.method.raster.gradient`.

Results do not depend on the number of threads. Every Gaussian is projected by itself, every tile is blended by itself,
and sums over tiles are taken in the order of the tiles.
"""

from gsmerge.method.raster.composite import Rendering, composite, contributions, splat_adjoint
from gsmerge.method.raster.images import render, render_in_batches
from gsmerge.method.raster.tiled_view import Splats, TiledView, make_splats, tile_view

__all__ = [
    "Rendering",
    "Splats",
    "TiledView",
    "composite",
    "contributions",
    "make_splats",
    "render",
    "render_in_batches",
    "splat_adjoint",
    "tile_view",
]
