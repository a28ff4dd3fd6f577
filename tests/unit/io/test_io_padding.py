"""Rows with which exporters fill a file up."""

from __future__ import annotations

from pathlib import Path

from exports import export_rows, save_export, smooth_scene

from gsmerge.io import load_scene


def test_rows_that_only_fill_a_file_up_are_left_out(tmp_path: Path) -> None:
    """As VolSplat writes them: at the origin, all alike."""
    smooth = smooth_scene(24, 16)
    rows = export_rows(smooth)
    rows[-40:] = rows[0]
    for name, value in (("x", 0), ("y", 0), ("z", 0), ("f_dc_0", 0.1), ("opacity", -4.6)):
        rows[name][-40:] = value
    rows["f_dc_1"][-1] = 0.7  # another one at the origin
    loaded = load_scene(save_export(tmp_path, smooth, rows), order="none")
    assert len(loaded.scene.gaussians) == len(rows) - 39
    assert "39 rows that only fill the file up are left out" in loaded.notes
