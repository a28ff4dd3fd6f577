"""Every processor writes the same bytes of eight results, which take two to three seconds together.

Other processors are stood for by targets of the native library and by what NumPy, its BLAS, OpenCV, its IPP, torch and
the C library leave unused (also tools/processors.py).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from exact_results import hash_of_all, make_results
from targets import runnable_targets

# One hash of the script's nine results, on every machine. After a change of results on purpose the failing test prints
# the new one.
SCRIPT = Path(__file__).parents[1] / "helpers" / "exact_results.py"
EXACT = "9f0b636c213b8afa782539a34d377139"


def plain() -> dict[str, str]:
    """Return settings of the libraries that take all that only some processors have from them."""
    return {
        "NPY_DISABLE_CPU_FEATURES": " ".join(np._core._multiarray_umath.__cpu_dispatch__),
        "OPENBLAS_CORETYPE": "Sandybridge",
        "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16",
        "OPENCV_IPP": "disabled",
        "ATEN_CPU_CAPABILITY": "default",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
    }


def test_this_machine_gives_the_same_bytes(tmp_path: Path) -> None:
    hashes = make_results(tmp_path)
    assert hash_of_all(hashes) == EXACT, hashes


@pytest.mark.slow
@pytest.mark.parametrize("target", runnable_targets())
def test_every_machine_gives_the_same_bytes(target: str) -> None:
    env = os.environ | plain() | {"GSMERGE_TARGET": target}
    done = subprocess.run([sys.executable, str(SCRIPT)], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["all"] == EXACT, done.stdout
