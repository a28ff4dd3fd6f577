"""Cells and tables of docs/results.md: run records as words and numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gsmerge.research.charts.lines import mean_interval
from gsmerge.research.charts.measure_run import INPUT, RunRecord

Row = Sequence[str]


def make_table(head: Row, rows: Sequence[Row]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def format_mean(records: Sequence[RunRecord], name: str, digits: int = 2) -> str:
    values = [v for r in records if (v := r.value(name)) is not None]
    return f"{np.mean(values):.{digits}f}" if values else "-"


def format_interval(records: Sequence[RunRecord], name: str) -> str:
    values = [v for r in records if (v := r.value(name)) is not None]
    if len(values) < 2:
        return "-"
    interval = mean_interval(values)
    return f"{interval.mean:.2f} ± {interval.high - interval.mean:.2f}"


def format_share(records: Sequence[RunRecord]) -> str:
    values = [r.ratio for r in records if r.ratio is not None]
    return f"{100 * np.mean(values):.1f} %" if values else "-"


def format_quality(records: Sequence[RunRecord], split: str = "target", part: str = "_visible") -> list[str]:
    return [format_mean(records, f"{m}_{split}{part}", d) for m, d in (("psnr", 2), ("ssim", 3), ("lpips_vgg", 3))]


QUALITY = ("PSNR", "SSIM", "LPIPS")


def describe_run(record: RunRecord) -> str:
    """A run's method and settings, for people."""
    settings = [f"{name} {value}" for name, value in record.settings.items() if name != "budget"]
    name = "the input" if record.method == INPUT else record.method
    return ", ".join([name, *settings])


def group_runs(
    records: Sequence[RunRecord], key: Callable[[RunRecord], tuple[object, ...]]
) -> dict[tuple[object, ...], list[RunRecord]]:
    """Records by key in their order, without keys that lack a scene that others have."""
    groups: dict[tuple[object, ...], list[RunRecord]] = {}
    for record in records:
        groups.setdefault(key(record), []).append(record)
    most = max((len({r.scene for r in some}) for some in groups.values()), default=0)
    return {k: some for k, some in groups.items() if len({r.scene for r in some}) == most}
