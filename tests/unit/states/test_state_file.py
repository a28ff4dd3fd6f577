"""The file of a state of both kinds: every kind of damage, and files of other versions."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import scenes
from hostile.gsm_files import (
    GSM_HEADERS,
    UNREADABLE,
    Spoil,
    assert_refused_in_one_line,
    damaged,
    filled,
    of_arrays,
    with_array,
    with_header,
    without,
)

from gsmerge import Compactor, read_scene
from gsmerge.errors import SceneError
from gsmerge.states.state_file import load_state

RESULTS = ("means", "quats", "scales", "opacities", "sh0", "shN", "viewmats", "Ks")
OF_RESULTS: dict[str, Spoil] = {
    "no images": with_array("images", None),
    "images of another size": with_array("images", lambda a: a[:, 1:]),
    "an image less": with_array("images", lambda a: a[1:]),
    "a name less": with_header(names=["a"]),
    "names by number": with_header(names=[1, 2]),
    "harmonics of degree 5": with_array("shN", lambda a: np.zeros((len(a), 35, 3), np.float32)),
    "no Gaussian is finite": with_array("means", lambda a: a * np.float32(np.nan)),
    "intrinsics of zeros": with_array("Ks", np.zeros_like),
    "views of zeros": with_array("viewmats", np.zeros_like),
    "views of 1e300": with_array("viewmats", filled(1e300)),
    **of_arrays(RESULTS, ("viewmats", "Ks")),
}
FEATURES = ("merged.means", "refined.latents", "views", "group", "samples.means", "unseen.means", "saliency", "origin")
OF_FEATURES: dict[str, Spoil] = {
    "no networks": without("networks"),
    "networks of another size": with_header(networks={"width": 32, "heads": 2, "latent": 4}),
    "a unit of zero": with_header(unit=0.0),
    "no unit": without("unit"),
    "views beyond": with_array("views", filled(99)),
    "merged views beyond": with_array("merged.views", filled(-2)),
    "groups of no members": with_array("num_members", np.zeros_like),
    "samples without pixels": with_array("samples.opacities", lambda a: a[:, :0]),
    "means of 3e38": with_array("merged.means", filled(3e38)),
    **of_arrays(FEATURES, ("merged.means", "refined.latents", "group", "saliency", "origin")),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A state of results and one of Feature Gaussians. Read only."""
    folder = tmp_path_factory.mktemp("states")
    scene = scenes.make_scene(scenes.room(), scenes.arc(2, 24, 18), degree=1)
    for name, settings in (("results", {}), ("features", {"recipe": "paper"})):
        compactor = Compactor(superpixels="10%", **settings)
        compactor.extend(scene)
        compactor.save(folder / f"{name}.gsm")
    return {name: folder / f"{name}.gsm" for name in ("results", "features")}


@pytest.mark.parametrize(
    ("kind", "damage"),
    [
        *(("results", name) for name in sorted({**UNREADABLE, **GSM_HEADERS, **OF_RESULTS})),
        *(("features", name) for name in sorted(OF_FEATURES)),
    ],
)
def test_damage_is_told_in_one_line(kind: str, damage: str, files: dict[str, Path], tmp_path: Path) -> None:
    path = Path(shutil.copy(files[kind], tmp_path / "a.gsm"))
    {**UNREADABLE, **GSM_HEADERS, **OF_RESULTS, **OF_FEATURES}[damage](path)
    assert_refused_in_one_line(load_state, path)


@pytest.mark.parametrize(("kind", "name"), [("results", "sh0"), ("features", "merged.sh0")])
def test_a_changed_byte_does_not_pass(kind: str, name: str, files: dict[str, Path], tmp_path: Path) -> None:
    path = Path(shutil.copy(files[kind], tmp_path / "a.gsm"))
    damaged(name)(path)
    assert f"{name}: expected the checksum" in assert_refused_in_one_line(load_state, path)


@pytest.mark.parametrize(("schema", "remedy"), [(2, "run extend again"), (9, "update gsmerge")])
def test_files_of_other_versions_say_what_to_do(
    schema: int, remedy: str, files: dict[str, Path], tmp_path: Path
) -> None:
    path = Path(shutil.copy(files["results"], tmp_path / "a.gsm"))
    with_header(schema=schema)(path)
    assert remedy in assert_refused_in_one_line(load_state, path)


def test_feature_gaussians_are_no_scene(files: dict[str, Path]) -> None:
    assert read_scene(files["results"]).num_gaussians == len(Compactor.load(files["results"]))
    with pytest.raises(SceneError, match="Feature Gaussians"):
        read_scene(files["features"])
