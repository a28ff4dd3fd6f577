"""A batch and the blocks of a scene survive lost nodes and processes of a real Ray cluster of two nodes."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from batches import FAST, NAMES, results, start, statuses
from messages import names
from shared import write_scene

pytestmark = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs gsmerge[ray]")
CLUSTER = """
import os, random, signal, subprocess, sys, threading, time
from pathlib import Path
from ray.cluster_utils import Cluster
from batches import holders
from gsmerge.cli import main

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
other, words = cluster.add_node(num_cpus=1), sys.argv[1:]
killed, ended = [], threading.Event()

def lose_a_node():
    while len(holders(Path(words[3]))) < 2:  # one processor each, so one on each node
        time.sleep(0.005)
    cluster.remove_node(other, allow_graceful=False)
    killed.append(other)

def busy():
    lines = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True).stdout.splitlines()
    return [int(words[0]) for words in map(str.split, lines) if words[1].startswith("ray::_call")]

def lose_processes():
    chance = random.Random(0)
    while len(killed) < 3 and not ended.is_set():
        time.sleep(chance.uniform(0, 0.3))
        for process in busy()[:1]:
            os.kill(process, signal.SIGKILL)
            killed.append(process)
            time.sleep(0.5)  # so that no call is lost more often than it is made again

thread = threading.Thread(target=lose_a_node if words[0] == "batch" else lose_processes, daemon=True)
thread.start()
code = main([*words, "--set", f"address={cluster.address}", "-q"])
ended.set()
thread.join(60)
print("killed:", len(killed))
cluster.shutdown()
sys.exit(code)
"""


def run_on_cluster(root: Path, *words: object) -> int:
    """Run a command on a cluster; return how many nodes or processes it has lost."""
    paths = os.pathsep.join([str(root), str(root / "tests" / "helpers"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", CLUSTER, *map(str, words)],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return int(done.stdout.rpartition("killed: ")[2])


def test_batch_survives_the_loss_of_a_node(
    rooms: Path, tmp_path: Path, root: Path, undisturbed: dict[str, str]
) -> None:
    assert run_on_cluster(root, "batch", rooms, "--output", tmp_path, *FAST, "--engine", "ray") == 1
    assert results(tmp_path) == undisturbed
    assert statuses(tmp_path) == {name: ["done"] for name in NAMES}


def test_missing_cluster_is_one_line_of_error(rooms: Path, tmp_path: Path) -> None:
    process = start(rooms, "--output", tmp_path / "out", *FAST, "--engine", "ray", "--set", "address=127.0.0.1:1", "-q")
    errors = process.communicate()[1]
    assert process.returncode == 3
    assert names(errors, "127.0.0.1:1", "Ray")


def test_cluster_makes_the_same_bytes(tmp_path: Path, root: Path) -> None:
    """Though three processes are lost."""
    scene = write_scene(tmp_path / "room", num_views=8, width=96, height=64, seed=2)
    pairs = ("blocks=4", "superpixels=5%", "fit_steps=60", "seed=3")
    words = ("compact", scene, *(word for pair in pairs for word in ("--set", pair)))
    here, there = tmp_path / "here.ply", tmp_path / "there.ply"
    subprocess.run([sys.executable, "-m", "gsmerge", *map(str, words), "-o", str(here), "-q"], check=True)
    assert run_on_cluster(root, *words, "-o", there, "--set", "engine=ray") == 3
    assert there.read_bytes() == here.read_bytes()
