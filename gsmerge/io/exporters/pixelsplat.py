"""The pixelSplat family: shared code, exporters that differ in order, trimming, rotations and world."""

from __future__ import annotations

from gsmerge.io.exporters.exporter import Exporter, FrameKind

# Recentred on the median, divided by a quantile, turned upright: a scale and a shift that are stored nowhere.
_UPRIGHT: tuple[FrameKind, ...] = ("upright",)

PIXELSPLAT = Exporter(
    "pixelsplat", "pixelSplat", "raw", "view-major", ("full",), _UPRIGHT, per_pixel=(1, 2, 3), quats="camera"
)
PIXELSPLAT_SCRIPT = Exporter(
    "pixelsplat-script", "pixelSplat's figure script", "raw", "view-fastest", ("trim", "pruned"), _UPRIGHT,
    per_pixel=(1, 2, 3), quats="camera",
)  # fmt: skip
MVSPLAT = Exporter("mvsplat", "MVSplat", "raw", "view-fastest", ("trim", "pruned"), _UPRIGHT)
SPFSPLAT = Exporter("spfsplat", "SPFSplat", "raw", "view-fastest", ("trim",), _UPRIGHT)
DEPTHSPLAT = Exporter("depthsplat", "DepthSplat", "logit", "view-fastest", ("trim",), ("first", "same"))
VOLSPLAT = Exporter("volsplat", "VolSplat", "logit", "none", frames=("first", "same"))
RESPLAT = Exporter(
    "resplat", "ReSplat", "logit", "view-major", ("full",), ("middle", "same"), degrees=(3,), quats="camera"
)
NOPOSPLAT = Exporter(
    "noposplat", "NoPoSplat", "raw", "view-major", ("full",), ("same", "scaled", "shifted", "other"), degrees=(0, 4)
)
YONOSPLAT = Exporter(
    "yonosplat", "YoNoSplat", "raw", "view-fastest", ("trim", "pruned"), ("same", "scaled", "shifted", "other"),
    quats="camera",
)  # fmt: skip
VICASPLAT = Exporter("vicasplat", "VicaSplat", "logit", "unordered", ("pruned",), degrees=(0, 4))
FLASH3D = Exporter("flash3d", "Flash3D", "raw", "layer-major", ("full",), _UPRIGHT, per_pixel=(2,))
SPLATT3R = Exporter(
    "splatt3r", "Splatt3R", "raw", "view-major", ("full",), ("same", "scaled", "shifted", "other"), quats="xyzw-root"
)
