"""A batch on a real Ray cluster of this machine, of which a process or a node is killed."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from batches import FAST, NAMES, holders, results, start, statuses, until
from messages import names

from .conftest import Run

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs gsmerge[ray]")


@needs_ray
def test_a_killed_process_is_survived(rooms: Path, tmp_path: Path, undisturbed: dict[str, str]) -> None:
    process = start(rooms, "--output", tmp_path, *FAST, "--engine", "ray", "-q")
    workers = until(lambda: holders(tmp_path), process)
    os.kill(workers[0], signal.SIGKILL)
    assert (process.communicate()[0], process.returncode) == ("", 0)
    assert results(tmp_path) == undisturbed
    assert statuses(tmp_path) == {name: ["done"] for name in NAMES}


CLUSTER = """
import sys, threading, time
from pathlib import Path
from ray.cluster_utils import Cluster
from batches import holders
from gsmerge.cli import main

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
other = cluster.add_node(num_cpus=1)
rooms, out, *told = sys.argv[1:]

def strike():
    while len(holders(Path(out))) < 2:  # one processor each, so one on each node
        time.sleep(0.005)
    cluster.remove_node(other, allow_graceful=False)

threading.Thread(target=strike, daemon=True).start()
code = main(["batch", rooms, "--output", out, "--engine", "ray", "--set", f"address={cluster.address}", *told])
print("nodes:", len(cluster.list_all_nodes()))
cluster.shutdown()
sys.exit(code)
"""


@needs_ray
def test_a_lost_node_is_survived(rooms: Path, tmp_path: Path, root: Path, undisturbed: dict[str, str]) -> None:
    paths = os.pathsep.join([str(root), str(root / "tests" / "helpers"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", CLUSTER, str(rooms), str(tmp_path), *FAST, "-q"],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "nodes: 1" in done.stdout
    assert results(tmp_path) == undisturbed
    assert statuses(tmp_path) == {name: ["done"] for name in NAMES}


@needs_ray
def test_no_cluster_at_the_address_is_one_line(rooms: Path, tmp_path: Path) -> None:
    process = start(rooms, "--output", tmp_path / "out", *FAST, "--engine", "ray", "--set", "address=127.0.0.1:1", "-q")
    errors = process.communicate()[1]
    assert process.returncode == 3
    assert names(errors, "127.0.0.1:1", "Ray")


def test_without_ray_one_line_says_what_to_install(
    small_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    done = run("batch", small_scene, "--output", tmp_path / "out", "--engine", "ray", code=2)
    assert (
        done.err
        == "gsmerge: error: engine ray: Ray is not installed; install gsmerge[ray], or pip install 'ray>=2.9,<3'\n"
    )
    assert not (tmp_path / "out").exists()
