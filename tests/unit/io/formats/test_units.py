"""Units of stored values are judged alike for every format, and a hint goes before each judgement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import noted, refuses
from numpy.lib.recfunctions import append_fields
from plyfile import PlyData, PlyElement
from slow_readers import drawn

from gsmerge.errors import SceneError, list_doubts
from gsmerge.io import read_gaussians, read_ply, write_gaussians
from gsmerge.io.formats.read_gaussians import file_notes
from gsmerge.io.formats.rows import LOGIT_COMMENT
from gsmerge.io.formats.splat import ROW
from gsmerge.method.geometry.transforms import sh0_to_rgb
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.types import Gaussians


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    scene = drawn(scenes.make_scene(scenes.room(), scenes.arc(2, 32, 24)), 0)
    return replace(scene, opacities=np.random.default_rng(0).uniform(0.02, 0.98, len(scene)).astype(np.float32))


def save_ply(path: Path, gaussians: Gaussians, **columns: np.ndarray) -> Path:
    """Write a .ply of another program, with some columns changed or added."""
    write_gaussians(path, gaussians, overwrite=True)
    rows = PlyData.read(str(path), mmap=False)["vertex"].data
    for name, values in columns.items():
        if name in (rows.dtype.names or ()):
            rows[name] = values
        else:
            rows = append_fields(rows, name, values, usemask=False)
    PlyData([PlyElement.describe(np.asarray(rows), "vertex")]).write(str(path))
    return path


def save_glb(path: Path, gaussians: Gaussians) -> Path:
    """Write a .glb of floats by another program."""
    from tests.unit.io.formats.test_glb import attributes_of
    from tests.unit.io.formats.test_glb import save_glb as save

    save(path, attributes_of(gaussians))
    return path


def logits(values: np.ndarray) -> np.ndarray:
    return log(values / (1 - values))


def test_floats_of_a_glb_beyond_its_rules_are_read_as_they_are_in_a_ply(gaussians: Gaussians, tmp_path: Path) -> None:
    """Logits and log scales, as drafts of the extension and some programs write them, are noted."""
    sound = read_gaussians(save_glb(tmp_path / "a.glb", gaussians))
    assert not file_notes(sound.info)
    stored = replace(gaussians, opacities=logits(gaussians.opacities), scales=log(gaussians.scales))
    odd = read_gaussians(save_glb(tmp_path / "b.glb", stored))
    np.testing.assert_allclose(odd.gaussians.opacities, sound.gaussians.opacities, atol=1e-6)
    np.testing.assert_allclose(odd.gaussians.scales, sound.gaussians.scales, rtol=1e-5)
    assert noted(file_notes(odd.info), "logits")
    assert noted(file_notes(odd.info), "logarithms")
    assert (odd.info.opacity_encoding, odd.info.opacity_guessed) == ("logit", True)
    for hint in ({"opacity": "raw"}, {"scales": "linear"}):
        ((name, value),) = hint.items()
        with refuses(SceneError, "b.glb", f"--hint {name}={value}"):
            read_gaussians(tmp_path / "b.glb", **hint)


def test_hints_count_for_every_format_that_stores_floats(gaussians: Gaussians, tmp_path: Path) -> None:
    path = save_glb(tmp_path / "a.glb", replace(gaussians, sh0=sh0_to_rgb(gaussians.sh0).clip(0, 1)))
    sound = read_gaussians(save_glb(tmp_path / "b.glb", gaussians)).gaussians
    np.testing.assert_allclose(
        read_gaussians(path, colors="rgb").gaussians.sh0, sound.sh0.clip(-1.773, 1.773), atol=1e-3
    )
    assert read_gaussians(path, opacity="logit").gaussians.opacities.min() > 0.5
    np.testing.assert_allclose(read_gaussians(path, scales="log").gaussians.scales, exp(sound.scales), rtol=1e-5)
    write_gaussians(tmp_path / "a.spz", gaussians)
    assert (
        read_gaussians(tmp_path / "a.spz", opacity="logit").gaussians.opacities.min() < 0.1
    )  # whole numbers of [0, 1]
    with refuses(ValueError, "colors", "logit"):
        read_gaussians(path, colors="hsv")  # type: ignore[arg-type]


def test_log_scales_of_a_splat_are_read_as_such(gaussians: Gaussians, tmp_path: Path) -> None:
    write_gaussians(path := tmp_path / "a.splat", gaussians)
    sound = read_gaussians(path)
    assert not file_notes(sound.info)
    rows = np.fromfile(path, ROW)
    rows["scales"] = log(rows["scales"])
    rows.tofile(path)
    odd = read_gaussians(path)
    np.testing.assert_allclose(odd.gaussians.scales, sound.gaussians.scales, rtol=1e-5)
    assert noted(file_notes(odd.info), "logarithms", "100 %")


def test_opacities_of_both_signs_below_one_are_noted(gaussians: Gaussians, tmp_path: Path) -> None:
    """As of a tanh, or of a model that is sure of nothing, which is no doubt; usual logits are not noted."""
    narrow = np.random.default_rng(1).uniform(-0.95, 0.95, len(gaussians))
    path = save_ply(tmp_path / "a.ply", gaussians, opacity=narrow)
    notes = file_notes(read_ply(path).info)
    assert noted(notes, "--hint opacity=logit")
    assert not list_doubts(notes)
    assert not file_notes(read_ply(path, opacity="logit").info)
    assert not file_notes(read_ply(save_ply(tmp_path / "b.ply", gaussians)).info)


def test_logits_of_colours_are_told_by_columns_of_colours(gaussians: Gaussians, tmp_path: Path) -> None:
    """Without such columns nothing is guessed; the hint says it."""
    colors = sh0_to_rgb(gaussians.sh0[:, 0]).clip(0.02, 0.98)
    stored = {f"f_dc_{i}": logits(colors[:, i]) for i in range(3)}
    plain = {name: np.round(255 * colors[:, i]).astype(np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    told = read_ply(save_ply(tmp_path / "a.ply", gaussians, **stored, **plain))
    np.testing.assert_allclose(sh0_to_rgb(told.gaussians.sh0[:, 0]), colors, atol=1e-5)
    assert noted(file_notes(told.info), "logits of RGB", "--hint colors=sh")
    path = save_ply(tmp_path / "b.ply", gaussians, **stored)
    assert not noted(file_notes(read_ply(path).info), "logits of RGB")
    np.testing.assert_allclose(read_ply(path, colors="logit").gaussians.sh0, told.gaussians.sh0, atol=1e-6)
    # beside harmonics, columns of colours change nothing
    assert not file_notes(read_ply(save_ply(tmp_path / "c.ply", gaussians, **plain)).info)


def test_units_that_gsmerge_states_are_not_judged(gaussians: Gaussians, tmp_path: Path) -> None:
    faint = replace(gaussians, opacities=np.full(len(gaussians), 0.6, np.float32))
    write_gaussians(path := tmp_path / "a.ply", faint, comments=[LOGIT_COMMENT])
    assert not file_notes(read_ply(path).info)
