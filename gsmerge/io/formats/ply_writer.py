"""Writing Gaussian splats as PLY."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from gsmerge.errors import UsageError
from gsmerge.io.atomic import atomic_output
from gsmerge.io.formats.ply_file import (
    BLOCK_BYTES,
    LOGIT_COMMENT,
    MAX_LOG_SCALE,
    MAX_LOGIT,
    MEANS,
    NORMALS,
    QUATS,
    SCALES,
    SH0,
)
from gsmerge.types import Gaussians


def write_ply(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    sh_degree: int | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write Gaussians in INRIA's column order, binary little-endian float32.

    Opacities become finite logits (within +-16), scales finite logarithms (within +-30), quaternions unit ones.

    Args:
        path: The file; complete or not there at all.
        gaussians: Finite values.
        overwrite: Replace an existing file.
        sh_degree: Drop harmonics above this degree; None keeps all.
        comments: Lines for the header, such as :func:`gsmerge.io.kept_comments` of another file.

    Raises:
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, fewer harmonics than asked for, or a comment is no line of ASCII.
    """
    if not all(comment.isascii() and comment.isprintable() for comment in comments):
        raise ValueError(f"comments: expected printable lines of ASCII, got {list(comments)}")
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise ValueError(f"sh_degree: expected 0 to {gaussians.sh_degree}, got {sh_degree}")
    num_higher = (degree + 1) ** 2 - 1
    header, num_columns = _header(len(gaussians), degree, comments)
    block = max(1, BLOCK_BYTES // (4 * num_columns))
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.write(header)
        for start in range(0, len(gaussians), block):
            rows = _stored(gaussians[start : start + block], num_higher)
            if not np.isfinite(rows).all():
                raise ValueError(f"expected finite Gaussians, got NaN or inf in rows from {start}")
            file.write(rows.data)


def _header(count: int, sh_degree: int, comments: Sequence[str] = ()) -> tuple[bytes, int]:
    """The header of a file of that many Gaussians, and its number of columns, all of them float32."""
    num_rest = 3 * ((sh_degree + 1) ** 2 - 1)
    names = [*MEANS, *NORMALS, *SH0, *(f"f_rest_{i}" for i in range(num_rest)), "opacity", *SCALES, *QUATS]
    lines = ["ply", "format binary_little_endian 1.0", f"comment {LOGIT_COMMENT}"]
    lines += [*(f"comment {comment}" for comment in comments), f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode("ascii"), len(names)


def file_bytes(count: int, sh_degree: int) -> int:
    """Size of the ``.ply`` of that many Gaussians, as :func:`write_ply` writes it without comments."""
    header, num_columns = _header(count, sh_degree)
    return len(header) + 4 * num_columns * count


def count_for_bytes(max_bytes: int, sh_degree: int) -> int:
    """Largest number of Gaussians whose ``.ply`` has at most ``max_bytes``.

    Raises:
        ValueError: If the degree is not 0 to 4.
        UsageError: If not even one fits.
    """
    if not 0 <= sh_degree <= 4:
        raise ValueError(f"sh_degree: expected 0 to 4, got {sh_degree}")
    if max_bytes < file_bytes(1, sh_degree):
        raise UsageError(
            f"budget: expected at least {file_bytes(1, sh_degree)} bytes for one Gaussian, got {max_bytes}"
        )
    count = (max_bytes - file_bytes(0, sh_degree)) // (file_bytes(2, sh_degree) - file_bytes(1, sh_degree))
    while file_bytes(count, sh_degree) > max_bytes:  # the header contains the count itself
        count -= 1
    return count


def _stored(part: Gaussians, num_higher: int) -> np.ndarray:
    """``[m,columns]`` values as the file holds them."""

    def array(tensor: torch.Tensor) -> np.ndarray[Any, np.dtype[np.float64]]:
        return tensor.detach().cpu().double().numpy()

    rows = np.zeros((len(part), 17 + 3 * num_higher), "<f4")
    rows[:, :3] = array(part.means)
    rows[:, 6:9] = array(part.sh0)[:, 0]
    last = 9 + 3 * num_higher
    rows[:, 9:last] = array(part.shN)[:, :num_higher].transpose(0, 2, 1).reshape(len(part), -1)
    with np.errstate(all="ignore"):  # opacities 0 and 1 and scales of 0 are clipped, what is not finite is refused
        opacities = array(part.opacities)
        rows[:, last] = np.clip(np.log(opacities) - np.log1p(-opacities), -MAX_LOGIT, MAX_LOGIT)
        rows[:, last + 1 : last + 4] = np.clip(np.log(array(part.scales)), -MAX_LOG_SCALE, MAX_LOG_SCALE)
    quats = array(part.quats)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    rows[:, last + 4 :] = np.where(length == 0, (1.0, 0.0, 0.0, 0.0), quats) / np.where(length == 0, 1, length)
    return rows
