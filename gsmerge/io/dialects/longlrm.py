"""Long-LRM: normals as bytes, 45 harmonics whatever the degree, sorted by opacity once it prunes."""

from __future__ import annotations

from gsmerge.io.dialects.dialect import Dialect

LONGLRM = Dialect(
    "longlrm", "Long-LRM", "logit", "view-major", ("full", "pruned"), ("same", "scaled", "shifted", "other"),
    degrees=(3,), byte_columns=("nx", "ny", "nz"),
)  # fmt: skip
LONGLRM_SORTED = Dialect(
    "longlrm-sorted", "Long-LRM, sorted by opacity", "logit", "unordered", ("pruned",), ("same", "scaled"),
    degrees=(3,), byte_columns=("nx", "ny", "nz"),
)  # fmt: skip
