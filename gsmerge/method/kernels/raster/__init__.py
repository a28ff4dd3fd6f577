"""Draw Gaussians, and differentiate drawings.

Many kernels take these arrays, which are float32 unless stated otherwise.

- ``means [n,3]``, ``quats [n,4]`` wxyz, ``scales [n,3]``, ``opacities [n]``, ``sh0 [n,1,3]`` and ``shN [n,k-1,3]``
  describe all Gaussians.
- ``ids [m]`` int32, ``conics [m,CONIC]`` and ``colors [m,3]`` describe the listed Gaussians, which may touch the image.
- ``flatten_ids [intersections]`` int32 has the rows of listed Gaussians, tile after tile. ``isect_offsets [tiles + 1]``
  int64 has the start of the list of each tile.
- ``camera [CAMERA]`` describes the camera, see :mod:`gsmerge.method.kernels.raster.project`.

``tile_width`` is the number of tiles in a row. ``first`` and ``last`` are a range of tiles or of Gaussians, ``last``
exclusive. ``height`` and ``width`` are the size of the image.
"""
