"""Convert the outputs of other libraries to arguments of :func:`gsmerge.compact_tensors`, by the names of fields.

None of these libraries is imported. Each function returns keyword arguments, so that callers can change any of them:

    gsmerge.compact_tensors(**gsmerge.integrations.depth_anything_3(prediction), budget="4%")
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gsmerge.arrays import Array, as_array, like
from gsmerge.errors import SceneError
from gsmerge.method.geometry.transforms import rotmat_to_quat
from gsmerge.method.kernels.matrices import eigh, invert


def depth_anything_3(prediction: Any, *, sh_degree: int = 0) -> dict[str, Any]:
    """Convert a ``Prediction`` of Depth Anything 3 with ``infer_gs=True``: one Gaussian per pixel, and the views.

    The files that the model writes lack Gaussians at borders and far away. Nested models give poses in metres, which
    are scaled to the units of the Gaussians.

    Args:
        prediction: Has ``gaussians`` (``means``, ``scales``, ``rotations``, ``harmonics``, ``opacities``),
            ``extrinsics`` world to camera, ``intrinsics`` in pixels, ``processed_images`` and ``scale_factor``.
        sh_degree: Harmonics above this degree are left out, as in the files that the model writes.

    Raises:
        SceneError: If a field is missing, or it holds several scenes.
    """
    gaussians = _get("prediction", prediction, "gaussians")
    rotations = _unbatch("rotations", gaussians.rotations, 2)
    photos = as_array(_get("prediction", prediction, "processed_images"))
    viewmats = as_array(_get("prediction", prediction, "extrinsics")).astype(np.float64)
    scale = getattr(prediction, "scale_factor", None)
    if scale is not None and getattr(prediction, "is_metric", False):
        viewmats[..., :3, 3] /= float(scale)
    return {
        **_convert_gaussians(gaussians, sh_degree),
        "scales": _unbatch("scales", gaussians.scales, 2),
        # The model makes z of a quaternion positive, as if z were w. Quaternions with negative w are negated here,
        # which keeps the rotations
        "quats": rotations * (1 - 2 * (rotations[:, :1] < 0)),
        "images": _as_floats(photos),
        "viewmats": viewmats,
        "Ks": _in_pixels_of(photos, as_array(_get("prediction", prediction, "intrinsics"))),
    }


def anysplat(gaussians: Any, poses: Mapping[str, Array], images: Array, *, sh_degree: int = 0) -> dict[str, Any]:
    """Convert the output of AnySplat's ``model.inference``: Gaussians of voxels, which have no pixels, and cameras.

    The files that the model writes have no cameras.

    Args:
        gaussians: Has ``means``, ``scales``, ``rotations`` xyzw (its files have w first), ``harmonics [1,n,3,k]`` and
            ``opacities``.
        poses: ``extrinsic [1,V,4,4]`` camera to world, ``intrinsic [1,V,3,3]`` divided by the image's size.
        images: ``[1,V,3,H,W]`` as the model got them, in [0, 1].
        sh_degree: Harmonics above this degree are left out, as in the files that the model writes.

    Raises:
        SceneError: If a field is missing, or it holds several scenes.
    """
    return {
        **_convert_gaussians(gaussians, sh_degree),
        "scales": _unbatch("scales", gaussians.scales, 2),
        "quats": _unbatch("rotations", gaussians.rotations, 2)[:, [3, 0, 1, 2]],
        **_convert_views(poses, "extrinsic", "intrinsic", images),
        "order": "none",
    }


def depthsplat(output: Any, context: Mapping[str, Array], *, sh_degree: int = 0) -> dict[str, Any]:
    """Convert the output of DepthSplat's encoder, with one Gaussian per pixel.

    Outputs of MVSplat, and of pixelSplat with one Gaussian per pixel, have the same form. The files that the model
    writes lack the Gaussians of pixels at borders. Scales and rotations are computed from the covariances, because the
    rotations in the output are relative to the cameras.

    Args:
        output: Output of the encoder: Gaussians with ``means``, ``covariances``, ``harmonics [1,n,3,k]`` and
            ``opacities``, or a dictionary with these Gaussians under ``gaussians``.
        context: Context of the batch: ``extrinsics [1,V,4,4]`` camera to world, ``intrinsics [1,V,3,3]`` divided by the
            image's size, ``image [1,V,3,H,W]`` in [0, 1].
        sh_degree: Harmonics above this degree are left out, as in the files that the model writes.

    Raises:
        SceneError: If a field is missing, or it holds several scenes.
    """
    gaussians = output["gaussians"] if isinstance(output, Mapping) else output
    covariances = _unbatch("covariances", _get("gaussians", gaussians, "covariances"), 3)
    scales, quats = _split_covariances(as_array(covariances).astype(np.float64))
    return {
        **_convert_gaussians(gaussians, sh_degree),
        "scales": like(scales, covariances),
        "quats": like(quats, covariances),
        **_convert_views(context, "extrinsics", "intrinsics", context["image"]),
    }


def ffgs(output: Any, images: Array | None = None, cameras: Any = None, *, sh_degree: int = 4) -> dict[str, Any]:
    """Convert a ``GSOutput`` of the library ffgs: Gaussians without pixels, and the cameras that the model predicted.

    Args:
        output: Has ``gaussians`` (``means``, ``scales``, ``quats`` wxyz, ``opacities``, and ``colors``: harmonics
            ``[1,n,k,3]``, or RGB ``[1,n,3]`` if its ``sh_degree`` is None) and ``cameras``, which may be None.
        images: ``[1,V,3,H,W]`` of the cameras' views, in [0, 1], at the model's input size; None: no photos.
        cameras: The library's ``Cameras`` in the frame of the output, such as ``views.cameras`` for
            ``output.to_world()``; None: the cameras of the output, if the output has any.
        sh_degree: Harmonics above this degree are left out.

    Raises:
        SceneError: If a field is missing, or it holds several scenes.
    """
    gaussians = _get("output", output, "gaussians")
    cameras = getattr(output, "cameras", None) if cameras is None else cameras
    opacities = _unbatch("opacities", _get("gaussians", gaussians, "opacities"), 1)
    used = opacities != 0  # rows with an opacity of 0 only pad the batch
    rows = {name: _unbatch(name, _get("gaussians", gaussians, name), 2)[used] for name in ("means", "scales", "quats")}
    if gaussians.sh_degree is None:
        colors = {"colors": _unbatch("colors", gaussians.colors, 2)[used]}
    else:
        harmonics = _unbatch("colors", gaussians.colors, 3)[used]
        colors = {"sh0": harmonics[:, :1], "shN": harmonics[:, 1 : (sh_degree + 1) ** 2]}
    arguments = {**rows, **colors, "opacities": opacities[used], "order": "none"}
    if cameras is None:
        return arguments
    c2w = as_array(_unbatch("c2w", cameras.c2w, 3)).astype(np.float64)
    arguments |= {"viewmats": invert(c2w), "Ks": as_array(_unbatch("pixel_k", cameras.pixel_k, 3)).astype(np.float64)}
    if images is None:
        return arguments | {"shape": (len(c2w), *cameras.image_shape)}
    return arguments | {"images": _as_floats(as_array(_unbatch("images", images, 4)).transpose(0, 2, 3, 1))}


def worldmirror(predictions: Mapping[str, Any], images: Array) -> dict[str, Any]:
    """Convert the predictions of WorldMirror: Gaussians of voxels, which belong to no pixels, and cameras.

    Args:
        predictions: ``splats`` with ``means``, ``scales``, ``quats`` wxyz, ``opacities`` and ``sh``, for a batch of one
            scene; ``camera_poses [1,V,4,4]`` camera to world, ``camera_intrs [1,V,3,3]`` in pixels.
        images: ``[1,V,3,H,W]`` as the model got them, in [0, 1].

    Raises:
        SceneError: If an entry is missing, or it holds several scenes.
    """
    splats: Any = _get("predictions", predictions, "splats")
    shapes = {"means": (-1, 3), "scales": (-1, 3), "quats": (-1, 4), "opacities": (-1,), "sh": (-1, 1, 3)}
    columns = {name: _unwrap(name, _get("splats", splats, name)).reshape(shape) for name, shape in shapes.items()}
    c2w = as_array(_unbatch("camera_poses", _get("predictions", predictions, "camera_poses"), 3)).astype(np.float64)
    Ks = as_array(_unbatch("camera_intrs", _get("predictions", predictions, "camera_intrs"), 3)).astype(np.float64)
    photos = as_array(_unbatch("images", images, 4)).transpose(0, 2, 3, 1)
    columns["sh0"] = columns.pop("sh")
    return {**columns, "images": _as_floats(photos), "viewmats": invert(c2w), "Ks": Ks, "order": "none"}


def _unwrap(name: str, values: Any) -> Any:
    """Return the only element of a list, or of an array's first axis; SceneError for any other number of elements."""
    if len(values) != 1:
        raise SceneError(name, f"expected a batch of one scene, found {len(values)}", "pass one scene")
    return values[0]


def _get(owner_name: str, owner: Any, name: str) -> Any:
    """Return a field of an object, or an entry of a mapping, by its name.

    Raises SceneError if the field or entry is missing or None.
    """
    value = owner.get(name) if isinstance(owner, Mapping) else getattr(owner, name, None)
    if value is None:
        remedy = "run the model with infer_gs=True" if name == "gaussians" else ""
        raise SceneError(owner_name, f"expected {name!r}, found none", remedy)
    return value


def _unbatch(name: str, values: Array, num_axes: int) -> Array:
    """Return an array with ``num_axes`` axes, without that of its batch; SceneError for a batch of several scenes."""
    if values.ndim == num_axes:
        return values
    if values.ndim != num_axes + 1 or values.shape[0] != 1:
        raise SceneError(name, f"expected a batch of one scene, found shape {list(values.shape)}", "pass one scene")
    return values[0]


def _convert_gaussians(gaussians: Any, sh_degree: int) -> dict[str, Array]:
    """Return the arguments for means, opacities and harmonics of models that store harmonics as ``[1,n,3,k]``."""
    harmonics = _unbatch("harmonics", _get("gaussians", gaussians, "harmonics"), 3)
    rows = harmonics.swapaxes(1, 2)[:, : (sh_degree + 1) ** 2]
    opacities = _get("gaussians", gaussians, "opacities")
    means = _unbatch("means", _get("gaussians", gaussians, "means"), 2)
    return {"means": means, "opacities": opacities, "sh0": rows[:, :1], "shN": rows[:, 1:]}


def _convert_views(
    poses: Mapping[str, Array], extrinsics: str, intrinsics: str, images: Array
) -> dict[str, np.ndarray]:
    """Return the arguments for the views of pixelSplat and its successors, from entries of ``poses`` by name.

    The poses of these models are camera to world, the intrinsics are relative to the image's size, and the images have
    the channels first.
    """
    c2w = as_array(_unbatch(extrinsics, _get("poses", poses, extrinsics), 3)).astype(np.float64)
    photos = as_array(_unbatch("images", images, 4)).transpose(0, 2, 3, 1)
    sizes = np.array([photos.shape[2], photos.shape[1], 1.0])
    Ks = as_array(_unbatch(intrinsics, _get("poses", poses, intrinsics), 3)).astype(np.float64) * sizes[:, None]
    return {"images": _as_floats(photos), "viewmats": invert(c2w), "Ks": Ks}


def _as_floats(photos: np.ndarray) -> np.ndarray:
    """Convert 8-bit photos to [0, 1]; leave float photos unchanged."""
    max_byte = 255.0  # largest value of an 8-bit image
    return photos / np.float32(max_byte) if photos.dtype == np.uint8 else photos


def _in_pixels_of(photos: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """Return intrinsics for the size of the photos.

    When Depth Anything 3 writes COLMAP files, it changes its intrinsics to those of the original photos. The principal
    point is in the middle of a photo at both sizes, so it shows to which size the intrinsics belong.
    """
    factors = np.array([photos.shape[-2], photos.shape[-3]]) / (2 * Ks[:, (0, 1), 2])
    min_difference = 0.1  # the sizes are different if they differ by more than this share in all views, on both axes
    is_other_size = np.abs(factors - 1).min() > min_difference
    return Ks * np.concatenate([factors, np.ones((len(Ks), 1))], 1)[:, :, None] if is_other_size else Ks


def _split_covariances(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split covariances ``[n,3,3]`` into standard deviations ``[n,3]`` and rotations ``[n,4]`` wxyz."""
    finite = np.isfinite(covariances).all((1, 2))  # all other rows get NaN as standard deviations
    squares, axes = eigh(np.where(finite[:, None, None], covariances, np.eye(3)))
    axes[:, :, 0] = np.cross(axes[:, :, 1], axes[:, :, 2])  # so that the axes are a rotation, and no reflection
    scales = np.sqrt(np.maximum(squares, 0))
    scales[~finite] = np.nan
    return scales.astype(np.float32), rotmat_to_quat(axes).astype(np.float32)
