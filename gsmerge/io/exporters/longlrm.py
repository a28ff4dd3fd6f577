"""Long-LRM: normals as bytes, 45 harmonics whatever the degree, sorted by opacity once it prunes."""

from __future__ import annotations

from gsmerge.io.exporters.exporter import Exporter

LONGLRM = Exporter(
    "longlrm", "Long-LRM", "logit", "view-major", ("full", "pruned"), ("same", "scaled", "shifted", "other"),
    degrees=(3,), byte_columns=("nx", "ny", "nz"),
)  # fmt: skip
LONGLRM_SORTED = Exporter(
    "longlrm-sorted", "Long-LRM, sorted by opacity", "logit", "unordered", ("pruned",), ("same", "scaled"),
    degrees=(3,), byte_columns=("nx", "ny", "nz"),
)  # fmt: skip
