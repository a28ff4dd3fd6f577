"""The pixelSplat family: shared code, exporters that differ in order, trimming, rotations and world."""

from __future__ import annotations

from gsmerge.io.dialects.dialect import Dialect, FrameKind

# Recentred on the median, divided by a quantile, turned upright: a scale and a shift that are stored nowhere.
_UPRIGHT: tuple[FrameKind, ...] = ("upright",)

PIXELSPLAT = Dialect(
    "pixelsplat", "pixelSplat", "raw", "view-major", ("full",), _UPRIGHT, per_pixel=(1, 2, 3), quats="camera"
)
PIXELSPLAT_SCRIPT = Dialect(
    "pixelsplat-script", "pixelSplat's figure script", "raw", "view-fastest", ("trim", "pruned"), _UPRIGHT,
    per_pixel=(1, 2, 3), quats="camera",
)  # fmt: skip
MVSPLAT = Dialect("mvsplat", "MVSplat", "raw", "view-fastest", ("trim", "pruned"), _UPRIGHT)
SPFSPLAT = Dialect("spfsplat", "SPFSplat", "raw", "view-fastest", ("trim",), _UPRIGHT)
DEPTHSPLAT = Dialect("depthsplat", "DepthSplat", "logit", "view-fastest", ("trim",), ("first", "same"))
VOLSPLAT = Dialect("volsplat", "VolSplat", "logit", "none", frames=("first", "same"))
RESPLAT = Dialect(
    "resplat", "ReSplat", "logit", "view-major", ("full",), ("middle", "same"), degrees=(3,), quats="camera"
)
NOPOSPLAT = Dialect(
    "noposplat", "NoPoSplat", "raw", "view-major", ("full",), ("same", "scaled", "shifted", "other"), degrees=(0, 4)
)
YONOSPLAT = Dialect(
    "yonosplat", "YoNoSplat", "raw", "view-fastest", ("trim", "pruned"), ("same", "scaled", "shifted", "other"),
    quats="camera",
)  # fmt: skip
VICASPLAT = Dialect("vicasplat", "VicaSplat", "logit", "unordered", ("pruned",), degrees=(0, 4))
FLASH3D = Dialect("flash3d", "Flash3D", "raw", "layer-major", ("full",), _UPRIGHT, per_pixel=(2,))
SPLATT3R = Dialect(
    "splatt3r", "Splatt3R", "raw", "view-major", ("full",), ("same", "scaled", "shifted", "other"), quats="xyzw-root"
)
