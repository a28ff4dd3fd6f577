"""Save the cameras of models that save none, by a few lines to paste next to the model's own inference.

    python examples/04_dump_views.py demo

``dump_views`` needs only numpy. Put its file ``views.npz`` next to the ``.ply``, where every command finds it:

    gsmerge compact gaussians.ply

Call it as follows:

* AnySplat: after ``gaussians, poses = model.inference(images)`` (``inference.py``)

      dump_views("views.npz", c2w=poses["extrinsic"][0].cpu().numpy(), K=poses["intrinsic"][0].cpu().numpy(),
                 images=(images[0].cpu().numpy() + 1) / 2, order="none")

* NoPoSplat: the Gaussians that ``export_ply`` saves are in the frame of the first camera

      context = batch["context"]
      dump_views("views.npz", c2w=c2w_of_first_camera(context["extrinsics"][0].cpu().numpy()),
                 K=context["intrinsics"][0].cpu().numpy(), images=(context["image"][0].cpu().numpy() + 1) / 2)

* Splatt3R: with the poses and the focal length that its aligner finds (``demo.py``). Rotations are read correctly with
  ``--hint exporter=splatt3r``

      dump_views("views.npz", c2w=scene.get_im_poses().cpu().numpy(), K=scene.get_intrinsics().cpu().numpy(),
                 images=numpy.stack(scene.imgs))

* Depth Anything 3 needs no dump: with ``export_format="npz-gs_ply"`` it writes its cameras itself.

As a script, this file dumps the cameras and photos of a synthetic scene, and reads them back.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np


def dump_views(path: str, c2w: np.ndarray, K: np.ndarray, images: np.ndarray, order: str = "auto") -> None:
    """Write cameras and photos of the views to a file that gsmerge reads.

    Args:
        path: The ``.npz``.
        c2w: ``[v,4,4]`` or ``[v,3,4]`` camera to world, OpenCV axes, in the world of the Gaussians.
        K: ``[v,3,3]`` in pixels of the images, or divided by their width and height.
        images: ``[v,h,w,3]`` or ``[v,3,h,w]`` as the network saw them; uint8, or float in [0, 1].
        order: Order of the rows: "view-major", "view-fastest", ...; "none" if Gaussians belong to no pixels; "auto" if
            gsmerge should find out.
    """
    if images.dtype != np.uint8:
        images = np.round(np.clip(images, 0, 1) * 255).astype(np.uint8)
    np.savez_compressed(path, c2w=c2w, K=K, images=images, order=order)


def c2w_of_first_camera(c2w: np.ndarray) -> np.ndarray:
    """Return poses ``[v,4,4]`` in the frame of the first camera, for models whose Gaussians are in this frame."""
    return np.linalg.inv(c2w[0]) @ c2w


def main() -> None:
    """Dump the views of a scene's folder, and read the scene with the dumped views alone."""
    import gsmerge

    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")
    scene = gsmerge.read_scene(folder)
    cameras = scene.cameras
    target = str(folder / "views.npz")
    dump_views(target, np.linalg.inv(cameras.viewmats), cameras.Ks, scene.images)
    again = gsmerge.read_scene(folder, cameras=target)
    print(f"{target}: {len(again)} views of {again.cameras.width} x {again.cameras.height}")


if __name__ == "__main__":
    main()
