from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsmerge.kernels import jit

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


def nowhere_to_write(monkeypatch: pytest.MonkeyPatch, temporary: Path) -> None:
    """No cache folder is named, none can be written, the account has no home; only the temporary folder is left."""

    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("GSMERGE_CACHE_DIR", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(jit, "_writable", lambda _: False)
    monkeypatch.setattr(jit.Path, "home", no_home)
    monkeypatch.setattr(jit.tempfile, "tempdir", str(temporary))


def test_the_temporary_folder_is_the_last_resort_and_the_user_s_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nowhere_to_write(monkeypatch, tmp_path)
    folder = jit.cache_folder().parent
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o077 == 0
    assert jit.cache_folder().parent == folder  # and is found again


@pytest.mark.skipif(os.name == "nt", reason="permissions are those of POSIX")
def test_a_folder_that_others_may_write_is_not_trusted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    nowhere_to_write(monkeypatch, tmp_path)
    shared = jit.cache_folder().parent
    shared.chmod(0o777)
    assert jit.cache_folder().parent != shared
    shared.rmdir()
    shared.symlink_to(tmp_path)
    assert jit.cache_folder().parent != shared


def test_a_named_folder_goes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GSMERGE_CACHE_DIR", str(tmp_path / "named"))
    assert jit.cache_folder().parent == tmp_path / "named"
