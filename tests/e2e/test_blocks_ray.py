"""Blocks of one scene on a real Ray cluster of two nodes, whose processes are killed."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs gsmerge[ray]")
SETTINGS = ("--set", "blocks=4", "--set", "superpixels=5%", "--set", "fit_steps=60", "--seed", "3", "-q")
CLUSTER = """
import os, random, signal, subprocess, sys, threading, time
from ray.cluster_utils import Cluster
from gsmerge.cli import main

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
cluster.add_node(num_cpus=1)
kills, *words = sys.argv[1:]
killed, ended = [], threading.Event()

def busy():
    lines = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True).stdout.splitlines()
    return [int(words[0]) for words in map(str.split, lines) if words[1].startswith("ray::_call")]

def strike():
    chance = random.Random(0)
    while len(killed) < int(kills) and not ended.is_set():
        time.sleep(chance.uniform(0, 0.3))
        for process in busy()[:1]:
            os.kill(process, signal.SIGKILL)
            killed.append(process)
            time.sleep(0.5)  # so that no call is lost more often than it is made again

thread = threading.Thread(target=strike, daemon=True)
thread.start()
code = main([*words, "--set", "engine=ray", "--set", f"address={cluster.address}"])
ended.set()
thread.join()
print("killed:", len(killed))
cluster.shutdown()
sys.exit(code)
"""


@pytest.fixture(scope="module")
def scene(make_scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of a room."""
    made: Path = make_scene(tmp_path_factory.mktemp("room") / "room", num_views=8, width=96, height=64, seed=2)
    return made


@needs_ray
@pytest.mark.parametrize("kills", [0, 3])
def test_a_cluster_makes_the_same_bytes(scene: Path, tmp_path: Path, root: Path, kills: int) -> None:
    here, there = tmp_path / "here.ply", tmp_path / "there.ply"
    words = ["compact", str(scene), *SETTINGS]
    subprocess.run([sys.executable, "-m", "gsmerge", *words, "-o", str(here)], check=True)
    paths = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", CLUSTER, str(kills), *words, "-o", str(there)],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"killed: {kills}" in done.stdout
    assert there.read_bytes() == here.read_bytes()
