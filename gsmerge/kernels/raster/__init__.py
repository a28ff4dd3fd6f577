"""Draw Gaussians, and differentiate drawings. Many kernels take these arrays, float32 unless stated otherwise:

- ``means [n,3]``, ``quats [n,4]`` wxyz, ``scales [n,3]``, ``opacities [n]``, ``sh0 [n,1,3]``, ``shN [n,k-1,3]``: all
  Gaussians;
- ``ids [m]`` int32, ``conics [m,CONIC]``, ``colors [m,3]``: the listed Gaussians, which are those that may touch the
  image;
- ``flatten_ids [intersections]`` int32: rows of listed Gaussians, tile after tile; ``isect_offsets [tiles + 1]`` int64:
  where the list of each tile starts; ``tile_width``: number of tiles in a row;
- ``camera [CAMERA]``: see :mod:`gsmerge.kernels.raster.project`.

``first`` and ``last`` are a range of tiles or of Gaussians, ``last`` exclusive. ``height`` and ``width`` are those of
the image.
"""
