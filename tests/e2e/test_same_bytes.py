"""The same bytes from every processor, by the libraries' own ways to use older instructions.

A processor is stood for by the target of the native library and by what NumPy, its BLAS, OpenCV, its IPP and torch are
told not to use. Each is one process that makes eight results, which takes some seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gsmerge.kernels.library import _able_targets

TARGETS = [target.name for target in _able_targets()]
OTHERS = [*TARGETS[:-1], None]  # None: this machine as it is
# One hash of the script's eight results, on every machine. After a change of results on purpose the failing test prints
# the new one.
SCRIPT = Path(__file__).parents[1] / "helpers" / "exact_results.py"
EXACT = "756a9b8c410ac76a0972fc21b09e1ede"


def plain() -> dict[str, str]:
    """Settings of the libraries that take all that only some processors have from them."""
    return {
        "NPY_DISABLE_CPU_FEATURES": " ".join(np._core._multiarray_umath.__cpu_dispatch__),
        "OPENBLAS_CORETYPE": "Sandybridge",
        "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16",
        "OPENCV_IPP": "disabled",
        "ATEN_CPU_CAPABILITY": "default",
    }


@pytest.mark.parametrize("target", [TARGETS[-1], *(pytest.param(one, marks=pytest.mark.slow) for one in OTHERS)])
def test_every_machine_gives_the_same_bytes(target: str | None) -> None:
    env = {key: value for key, value in os.environ.items() if key not in plain()}
    env |= plain() | {"GSMERGE_TARGET": target} if target else {}
    command = [sys.executable, str(SCRIPT)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["all"] == EXACT, done.stdout
