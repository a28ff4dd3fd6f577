"""Fit, compose, invert and round similarities."""

from __future__ import annotations

import numpy as np

from gsmerge.geometry.transforms import Similarity, normalize, quat_to_rotmat, rotmat_to_quat
from gsmerge.kernels.matrices import eigh, matmul, transform

DIGITS = 7  # decimals to which a similarity is rounded; further digits have no meaning


def fit_similarities(p: np.ndarray, q: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit ``q = scale * rotation @ p + shift`` to b sets of points ``[b,n,3]`` with weights ``[b,n]``.

    Rotations are solved as by Horn (1987). The scale is the ratio of the spreads of ``q`` and ``p``, since both have
    errors. Returns rotations ``[b,3,3]``, scales ``[b]`` and shifts ``[b,3]``.
    """
    share = (weights / weights.sum(1, keepdims=True))[..., None]
    middle_p = (share * p).sum(1)
    middle_q = (share * q).sum(1)
    a = p - middle_p[:, None]
    b = q - middle_q[:, None]
    scales = np.sqrt(_spread(b, share) / _spread(a, share))
    m = matmul((share * b).swapaxes(1, 2), a)  # covariance of the two sets
    trace = np.trace(m, axis1=1, axis2=2)
    axis = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    # the quaternion is the eigenvector of the largest eigenvalue of the quadratic form ``form``
    form = np.empty((len(m), 4, 4))
    form[:, 0, 0] = trace
    form[:, 0, 1:] = axis
    form[:, 1:, 0] = axis
    form[:, 1:, 1:] = m + m.swapaxes(1, 2) - trace[:, None, None] * np.eye(3)
    rotations = quat_to_rotmat(eigh(form)[1][:, :, -1])
    shifts = middle_q - scales[:, None] * transform(rotations, middle_p)
    return rotations, scales, shifts


def _spread(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the weighted mean square ``[b]``, above 0, of b sets of centred points ``[b,n,3]``."""
    return np.asarray(np.maximum((share * points**2).sum((1, 2)), 1e-30))


def compose(second: Similarity, first: Similarity) -> Similarity:
    """Compose two similarities: apply ``first``, then ``second``."""
    rotation = matmul(second.rotation, first.rotation)
    shift = second.move_points(first.shift)
    return Similarity(rotation, second.scale * first.scale, shift)


def invert_similarity(similarity: Similarity) -> Similarity:
    """Return the inverse of a similarity."""
    shift = -matmul(similarity.rotation.T, similarity.shift) / similarity.scale
    return Similarity(similarity.rotation.T, 1 / similarity.scale, shift)


def round_similarity(similarity: Similarity, unit: float) -> Similarity:
    """Return a rounded similarity, so that tiny differences between keypoints do not change results.

    ``unit`` is the unit in which the shift is rounded.
    """
    quat = normalize(rotmat_to_quat(similarity.rotation[None]).round(DIGITS))
    shift = unit * (similarity.shift / unit).round(DIGITS)
    return Similarity(quat_to_rotmat(quat)[0], round(similarity.scale, DIGITS), shift)
