"""Kernels that other kernels call are inlined, so that one input has one result whatever was compiled before."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

RENDER_SUMS = """
import hashlib, sys
import numpy as np
import gsmerge
from gsmerge.render import contributions, plan_view, prepare, splat_adjoint

rng = np.random.default_rng(0)
n, (h, w) = 400, (48, 64)
arrays = [rng.uniform(-1, 1, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.02, 0.2, (n, 3)), rng.uniform(0, 1, n)]
arrays += [rng.normal(size=(n, 1, 3)), np.zeros((n, 0, 3))]
splats = prepare(gsmerge.Gaussians(*(array.astype(np.float32) for array in arrays)))
viewmat = np.eye(4)
viewmat[2, 3] = 3
plan = plan_view(splats, viewmat, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), w, h)
if "contributions first" in sys.argv:
    contributions(plan)
sums = splat_adjoint(plan, rng.random((h, w, 4)).astype(np.float32))
print(hashlib.sha256(sums.tobytes()).hexdigest())
"""


def kernels(root: Path) -> Iterator[tuple[str, ast.FunctionDef, str]]:
    """Name, definition and decorator of every kernel."""
    for path in sorted((root / "gsmerge" / "kernels").rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef):
                for decorator in map(ast.unparse, node.decorator_list):
                    if decorator.split("(")[0] == "kernel":
                        yield node.name, node, decorator


def test_what_kernels_call_is_inlined(root: Path) -> None:
    actual = list(kernels(root))
    names = {name for name, _, _ in actual}
    called = {
        call.func.id
        for _, node, _ in actual
        for call in ast.walk(node)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
    } & names
    assert len(called) > 10
    loose = {
        name
        for name, _, decorator in actual
        if name in called
        and not name.startswith("_")
        and "part=True" not in decorator
        and "inline=True" not in decorator
    }
    assert loose == set()


@pytest.mark.slow
def test_results_do_not_depend_on_what_was_compiled_before(tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Compiled just now, loaded from the cache, and after another kernel that shares its parts: the same bits."""
    monkeypatch.setenv("GSMERGE_CACHE_DIR", str(tmp_path))
    sums = [
        subprocess.run(
            [sys.executable, "-c", RENDER_SUMS, *arguments], capture_output=True, text=True, check=True
        ).stdout
        for arguments in ([], [], ["contributions first"])
    ]
    assert len(set(sums)) == 1
