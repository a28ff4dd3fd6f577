"""Models of one image, or of a few of one object."""

from __future__ import annotations

from gsmerge.io.dialects.dialect import Dialect

SHARP = Dialect(
    "sharp", "SHARP", "logit", "layer-major", ("full",), per_pixel=(2,), normals=False,
    elements=("extrinsic", "intrinsic", "image_size"),
)  # fmt: skip
SPLATTER_IMAGE = Dialect(
    "splatter-image", "Splatter Image", "logit", "view-major", ("pruned", "full"), ("same", "scaled", "other"),
    degrees=(1,),
)  # fmt: skip
