"""Models of one image, or of a few of one object."""

from __future__ import annotations

from gsmerge.io.exporters.exporter import Exporter

SHARP = Exporter(
    "sharp", "SHARP", "logit", "layer-major", ("full",), per_pixel=(2,), normals=False,
    elements=("extrinsic", "intrinsic", "image_size"),
)  # fmt: skip
SPLATTER_IMAGE = Exporter(
    "splatter-image", "Splatter Image", "logit", "view-major", ("pruned", "full"), ("same", "scaled", "other"),
    degrees=(1,),
)  # fmt: skip
