"""Run the tests as on other x86-64 processors, with settings of libraries that leave instructions unused.

python tools/processors.py                      # as on each processor, one after the other
python tools/processors.py oldest -x tests/unit # as on one; the words after its name are passed to pytest

A setting has no effect if this machine does not have the instructions anyway, such as AVX-512.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
# Sets of instructions among which NumPy chooses at run time
DISPATCHED = np._core._multiarray_umath.__cpu_dispatch__
NUMPY, BLAS, OPENCV, GLIBC, OURS = (
    "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_CORETYPE", "OPENCV_CPU_DISABLE", "GLIBC_TUNABLES", "GSMERGE_TARGET",
)  # fmt: skip
WITHOUT_AVX2 = {  # variables of the environment by library
    NUMPY: {NUMPY: " ".join(DISPATCHED)},
    OPENCV: {OPENCV: "AVX2,FP16"},
    GLIBC: {GLIBC: "glibc.cpu.hwcaps=-AVX2,-FMA"},
}
# Variables of the environment by name of a processor
PROCESSORS: dict[str, dict[str, str]] = {
    "numpy-avx2": {NUMPY: " ".join(name for name in DISPATCHED if name == "X86_V4" or name.startswith("AVX512"))},
    "numpy-sse": WITHOUT_AVX2[NUMPY],
    **{f"openblas-{name.lower()}": {BLAS: name} for name in ("Haswell", "SkylakeX", "Zen")},
    "opencv-sse": WITHOUT_AVX2[OPENCV],
    "glibc-sse": WITHOUT_AVX2[GLIBC],
    "kernels-v3": {OURS: "v3"},
    "kernels-v4": {OURS: "v4"},
    "oldest": {name: value for one in WITHOUT_AVX2.values() for name, value in one.items()}
    | {BLAS: "Sandybridge", OURS: "v3"},
}


def main(words: list[str]) -> int:
    """Run the tests as on the processor that the first word names, or as on all; return the first exit code but 0."""
    names = words[:1] if words and words[0] in PROCESSORS else list(PROCESSORS)
    options = words[len(names) :] if len(names) == 1 else words
    codes = {}
    for name in names:
        print(f"+ {name}:", *(f"{key}={value!r}" for key, value in PROCESSORS[name].items()), flush=True)
        start = perf_counter()
        command = [sys.executable, "-m", "pytest", "-q", *options]
        codes[name] = subprocess.run(command, cwd=ROOT, env=os.environ | PROCESSORS[name], check=False).returncode
        print(f"{name}: exit code {codes[name]} after {perf_counter() - start:.0f} s", flush=True)
    return next(filter(None, codes.values()), 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
