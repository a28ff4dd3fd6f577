"""Principal axes of covariances, and what moments look like as Gaussians; see :mod:`gsmerge.moments`."""

from __future__ import annotations

import torch
from torch import Tensor

from gsmerge.gpu.scene import Features
from gsmerge.moments import MAX_OPACITY, MIN_SCALE
from gsmerge.types import Gaussians

SWEEPS = 6  # of Jacobi rotations: they converge quadratically, and matrices of 3 x 3 are done after five


def principal_axes(covars: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations ``[g,3]`` (rising) and unit quaternions ``[g,4]`` (w at least 0) of covariances ``[g,3,3]``.

    Cyclic Jacobi sweeps in float64, all matrices at once, as the kernel ``decompose`` does them one by one. (The
    batched ``eigh`` of CUDA is limited in the size of a batch, and slower on matrices as small as these.)
    """
    a = [[covars[:, i, j].double() for j in range(3)] for i in range(3)]
    one, zero = torch.ones_like(a[0][0]), torch.zeros_like(a[0][0])
    u = [[one if i == j else zero for j in range(3)] for i in range(3)]
    for _ in range(SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            _rotate_pair(a, u, p, q)
    diagonal = torch.stack([a[0][0], a[1][1], a[2][2]], 1)
    order = torch.sort(diagonal, dim=1, stable=True).indices
    scales = diagonal.gather(1, order).clamp_min(0).sqrt().clamp_min(MIN_SCALE)
    axes = torch.stack([torch.stack(row, 1) for row in u], 1)  # [g,3,3], eigenvectors as columns
    return scales, right_handed_quats(axes.gather(2, order[:, None].expand(-1, 3, -1)))


def _rotate_pair(a: list[list[Tensor]], u: list[list[Tensor]], p: int, q: int) -> None:
    """One Jacobi rotation of symmetric matrices ``a`` that zeroes a[p][q]; ``u`` collects the eigenvectors."""
    off = a[p][q]
    turns = off.abs() > 1e-300
    theta = (a[q][q] - a[p][p]) / torch.where(turns, 2 * off, 1.0)
    t = torch.where(theta < 0, -1.0, 1.0) / (theta.abs() + (theta * theta + 1).sqrt())
    t = torch.where(turns, t, 0.0)
    c = 1 / (t * t + 1).sqrt()
    s = t * c
    for k in range(3):
        x, y = a[k][p], a[k][q]
        a[k][p], a[k][q] = c * x - s * y, s * x + c * y
    for k in range(3):
        x, y = a[p][k], a[q][k]
        a[p][k], a[q][k] = c * x - s * y, s * x + c * y
        x, y = u[k][p], u[k][q]
        u[k][p], u[k][q] = c * x - s * y, s * x + c * y


def right_handed_quats(axes: Tensor) -> Tensor:
    """``[g,4]`` unit quaternions wxyz, w at least 0, of orthogonal matrices ``[g,3,3]``.

    In left-handed ones the first axis is turned round. Of the four ways to write it (Shepperd 1978), the one that
    divides by the largest component.
    """
    signs = torch.ones_like(axes[:, :1])
    signs[:, 0, 0] = torch.where(determinants(axes) < 0, -1.0, 1.0)
    axes = axes * signs
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = (row.unbind(1) for row in axes.unbind(1))
    a, b, c, d, e, f = r21 - r12, r02 - r20, r10 - r01, r10 + r01, r20 + r02, r21 + r12
    squares = [1 + r00 + r11 + r22, 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22]
    rows = [(squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3])]
    best = torch.stack(squares, 1).argmax(1)
    ways = torch.stack([torch.stack(row, 1) for row in rows], 1)
    quats = ways.gather(1, best[:, None, None].expand(-1, 1, 4))[:, 0]
    quats = quats / quats.norm(dim=1, keepdim=True)
    return torch.where(quats[:, :1] < 0, -quats, quats)


def determinants(matrices: Tensor) -> Tensor:
    """``[g]`` of matrices ``[g,3,3]``, written out: libraries for small matrices take longer to start than this."""
    x, y, z = matrices.unbind(1)
    return (torch.linalg.cross(x, y) * z).sum(1)


def to_gaussians(covars: Tensor, extinctions: Tensor, spreads: Tensor, means: Tensor, sh: Tensor) -> Gaussians:
    """Gaussians of given moments, float64; opacity from the conserved optical depth over the (unspread) disc."""
    scales, quats = principal_axes(covars)
    opacities = 1 - (-extinctions / (scales[:, 1] * scales[:, 2])).exp()
    return Gaussians(
        means=means.float(),
        quats=quats.float(),
        scales=(scales * spreads[:, None]).float(),
        opacities=opacities.clamp(0, MAX_OPACITY).float(),
        sh0=sh[:, :1].float(),
        shN=sh[:, 1:].float(),
    )


def feature_to_gaussians(features: Features) -> Gaussians:
    """One Gaussian per Feature Gaussian (K = 1)."""
    return to_gaussians(
        features.covars.double(),
        (features.extinctions * features.gains).double(),
        features.spreads.double(),
        features.means,
        torch.cat([features.sh0, features.shN], 1),
    )
