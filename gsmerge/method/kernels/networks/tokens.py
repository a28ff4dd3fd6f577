"""Compute the inputs of the networks in the frame of each group, and apply the corrections that networks put out.

Arrays are float32, and ids int64. Corrections ``residuals`` have 13 columns, see
:mod:`gsmerge.method.networks.corrections`. Corrections are applied in place, and a correction of zero changes no bit.
The columns of a frame are its axes.
"""

from __future__ import annotations

from gsmerge.method.kernels.signature import STATUS, f4, f8, i8, native


@native(
    means=f4("g", 3), scales=f4("g", 3), viewmats=f8("v", 4, 4), views=i8("g", least=0, below="v"),
    frames=f4("g", 3, 3, out=True), sizes=f4("g", out=True),
)  # fmt: skip
def place_frames(means, scales, viewmats, views, frames, sizes):
    """Write the frame and the size of each group. The size of a group is the geometric mean of its two largest scales.

    The columns of a frame are axes in the world: right and down in the picture of the group's view, and along the ray
    from the camera to the group.
    """


@native(
    STATUS, means=f4("g", 3), scales=f4("g", 3), opacities=f4("g"), sh0=f4("g", 1, 3), covars=f4("g", 3, 3),
    masses=f4("g"), extinctions=f4("g"), weights=f4("g"), counts=i8("g"), footprints=f4("g"), frames=f4("g", 3, 3),
    sizes=f4("g"), viewmats=f8("v", 4, 4), views=i8("g", least=0, below="v"), out=f4("g", "columns", out=True),
)  # fmt: skip
def describe_groups(
    means, scales, opacities, sh0, covars, masses, extinctions, weights, counts, footprints, frames, sizes, viewmats,
    views, out,
):  # fmt: skip
    """Write the first 19 numbers that describe each group.

    The numbers are log scales (3), the logit of the opacity, the mass, the optical depth, the number of members
    ``counts``, their mean opacity, the colour (3), entries of the covariance (6), and the tangents of the two angles
    between the ray and the axis of the view.
    """


@native(
    STATUS, means=f4("parts", 3), quats=f4("parts", 4), scales=f4("parts", 3), opacities=f4("parts"),
    sh0=f4("parts", 1, 3), group_means=f4("g", 3), group_sh0=f4("g", 1, 3), frames=f4("g", 3, 3), sizes=f4("g"),
    footprints=f4("g"), ids=i8("n", least=0, below="parts"), owners=i8("n", least=0, below="g"),
    members=i8(least=0, most=1), out=f4("n", "columns", out=True),
)  # fmt: skip
def describe_parts(
    means, quats, scales, opacities, sh0, group_means, group_sh0, frames, sizes, footprints, ids, owners, members, out
):
    """Write 13 numbers that describe each of the Gaussians ``ids`` relative to its group in ``owners``.

    The numbers are the position (3), log scales (3), the logit of the opacity, the colour (3) and the normal (3). If
    ``members`` is 1, six more follow: the position in pixels (3), and the colour, which is not relative (3).
    """


@native(
    means=f4("g", 3, out=True), covars=f4("g", 3, 3, out=True), masses=f4("g", out=True),
    extinctions=f4("g", out=True), sh0=f4("g", 1, 3, out=True), quats=f4("g", 4), scales=f4("g", 3),
    frames=f4("g", 3, 3), residuals=f4("g", 13),
)  # fmt: skip
def correct_features(means, covars, masses, extinctions, sh0, quats, scales, frames, residuals):
    """Apply the corrections ``residuals [g,13]`` to Feature Gaussians in place.

    Gaussians with ``quats`` and ``scales`` have the moments of the Feature Gaussians.
    """


@native(
    means=f4("n", 3, out=True), quats=f4("n", 4, out=True), scales=f4("n", 3, out=True), opacities=f4("n", out=True),
    sh0=f4("n", 1, 3, out=True), residuals=f4("n", 13), frames=f4("g", 3, 3), owners=i8("n", least=0, below="g"),
)  # fmt: skip
def correct_gaussians(means, quats, scales, opacities, sh0, residuals, frames, owners):
    """Apply corrections ``residuals [n,13]`` to Gaussians in place, in the ``frames`` of their groups ``owners``."""
