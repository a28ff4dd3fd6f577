"""Corrections of Gaussians and Feature Gaussians, in place; a correction of zero changes no bit.

Arrays are float32. Corrections have 13 columns, see :mod:`gsmerge.networks.corrections`; frames have axes as columns.
"""

from __future__ import annotations

from gsmerge.kernels.signature import f4, i8, native


@native(
    means=f4("g", 3, out=True), covars=f4("g", 3, 3, out=True), masses=f4("g", out=True),
    extinctions=f4("g", out=True), sh0=f4("g", 1, 3, out=True), quats=f4("g", 4), scales=f4("g", 3),
    frames=f4("g", 3, 3), residuals=f4("g", 13),
)  # fmt: skip
def correct_features(means, covars, masses, extinctions, sh0, quats, scales, frames, residuals):
    """Correct Feature Gaussians with principal axes ``quats`` and ``scales``."""


@native(
    means=f4("n", 3, out=True), quats=f4("n", 4, out=True), scales=f4("n", 3, out=True), opacities=f4("n", out=True),
    sh0=f4("n", 1, 3, out=True), residuals=f4("n", 13), frames=f4("g", 3, 3), owners=i8("n", least=0, below="g"),
)  # fmt: skip
def correct_gaussians(means, quats, scales, opacities, sh0, residuals, frames, owners):
    """Correct Gaussians in the frames of their groups ``owners``."""
