from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CODE = """
import numpy as np
from gsmerge.kernels.compilation import watch_compilation
from gsmerge.kernels.jit import kernel
from kernels_to_compile import twice

with watch_compilation(lambda: print("compiling")):
    twice(np.ones(3))
    twice(np.ones(3, np.float32))
"""


def test_compilation_is_noticed_once_and_not_when_cached(tmp_path: Path, root: Path) -> None:
    (tmp_path / "kernels_to_compile.py").write_text(
        "from gsmerge.kernels.jit import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n"
    )
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": f"{root}{os.pathsep}{tmp_path}"}
    outputs = [
        subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, env=env).stdout
        for _ in range(2)
    ]
    assert outputs == ["compiling\n", ""]
