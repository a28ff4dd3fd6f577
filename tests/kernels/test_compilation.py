from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
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


def process(folder: Path, root: Path) -> tuple[str, str]:
    """Output and errors of a process that compiles, or loads, two versions of a kernel."""
    (folder / "kernels_to_compile.py").write_text(
        "from gsmerge.kernels.jit import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n"
    )
    env = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": f"{root}{os.pathsep}{folder}"}
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, env=env)
    return done.stdout, done.stderr


def test_compilation_is_noticed_once_and_not_when_cached(tmp_path: Path, root: Path) -> None:
    assert [process(tmp_path, root) for _ in range(2)] == [("compiling\n", ""), ("", "")]


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut to nothing": lambda _: b"", "cut to 4 zeros": lambda _: bytes(4), "cut to 10": lambda data: data[:10],
    "cut by one": lambda data: data[:-1], "of zeros": lambda data: bytes(len(data)),
    "with a bit flipped": lambda data: data[:-99] + bytes([data[-99] ^ 1]) + data[-98:],
}  # fmt: skip


def test_damaged_caches_are_compiled_again_and_it_is_said(tmp_path: Path, root: Path) -> None:
    process(tmp_path, root)
    for suffix in ("nbi", "nbc"):
        for name, damage in DAMAGE.items():
            files = list((tmp_path / "cache").rglob(f"*.{suffix}"))
            assert files
            for file in files:
                file.write_bytes(damage(file.read_bytes()))
            out, err = process(tmp_path, root)
            assert (out, err.count("damaged: compiled again\n")) == ("compiling\n", 1), f"{suffix} {name}"
            assert process(tmp_path, root) == ("", ""), f"{suffix} {name} is not mended"


def test_a_checksum_that_holds_is_not_trusted_blindly(tmp_path: Path, root: Path) -> None:
    process(tmp_path, root)
    for file in (tmp_path / "cache").rglob("*.nb?"):
        file.write_bytes(b"no pickle" + jit._checksum(b"no pickle"))
    out, err = process(tmp_path, root)
    assert (out, err.count("RuntimeWarning")) == ("compiling\n", 1)
    assert process(tmp_path, root) == ("", "")


def test_a_full_disk_keeps_no_kernel_and_does_not_end_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jit, "_CACHE", str(tmp_path))
    monkeypatch.setattr(jit, "_warned", set())
    double = jit.kernel(double_of)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(jit._CacheFiles, "save", full)
    with pytest.warns(RuntimeWarning, match="cannot be kept in .*No space left"):
        assert double(2.0) == 4.0


def double_of(x: float) -> float:
    return 2 * x


def test_folders_of_another_user_are_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GSMERGE_CACHE_DIR", str(tmp_path / "named"))
    own, writable = jit.cache_folder(), jit._writable
    assert jit.cache_folder() == own
    (own / "raster").mkdir()
    monkeypatch.setattr(jit, "_writable", lambda folder: folder.name != "raster" and writable(folder))
    assert jit.cache_folder() != own


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
