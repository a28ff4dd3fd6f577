"""The right library is loaded, and where none fits the error says what to do."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from messages import ERROR, refuses
from numpy.random import mtrand
from targets import runnable_targets

from gsmerge.errors import UsageError
from gsmerge.method.kernels import library as module
from gsmerge.method.kernels.build import ARM64, FOLDER, V3, V4, Platform, find_platform, hash_sources
from gsmerge.method.kernels.library import load_library


@pytest.fixture(autouse=True)
def _fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Load anew, with no variable set."""
    for name in ("GSMERGE_TARGET", "GSMERGE_NATIVE"):
        monkeypatch.delenv(name, raising=False)
    load_library.cache_clear()
    module._open_library.cache_clear()
    yield
    load_library.cache_clear()
    module._open_library.cache_clear()


class OldProcessor:
    """A library on a processor of some level."""

    def __init__(self, level: int) -> None:
        self.level = level

    def processor_level(self) -> int:
        return self.level


x86_only = pytest.mark.skipif(find_platform().machine != "x86_64", reason="needs an x86-64 processor")


def set_level(monkeypatch: pytest.MonkeyPatch, level: int) -> None:
    monkeypatch.setattr(module, "_open_library", lambda target: (target.name, OldProcessor(level))[1])
    monkeypatch.setattr(module._open_library, "cache_clear", lambda: None, raising=False)


def test_most_demanding_target_of_the_processor_is_loaded() -> None:
    assert load_library()._name == str(FOLDER / f"kernels-{runnable_targets()[-1]}{find_platform().suffix}")


@x86_only
def test_a_target_can_be_forced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_TARGET", "v3")
    assert load_library()._name == str(FOLDER / find_platform().library_name(V3))


@pytest.mark.parametrize("target", ["v5", "V3", "x86-64-v3"])
def test_unknown_target_is_refused(target: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_TARGET", target)
    with refuses(UsageError, "GSMERGE_TARGET", f"'{target}'"):
        load_library()


@x86_only
@pytest.mark.parametrize("level", [0, 2])
def test_an_older_processor_is_refused_in_one_line(level: int, monkeypatch: pytest.MonkeyPatch) -> None:
    set_level(monkeypatch, level)
    with pytest.raises(UsageError, match=r"expected a processor with AVX2 and FMA .*, found an older one$"):
        load_library()


@x86_only
def test_a_target_beyond_the_processor_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    set_level(monkeypatch, 3)
    monkeypatch.setenv("GSMERGE_TARGET", "v4")
    with refuses(UsageError, "GSMERGE_TARGET", "v3", "'v4'"):
        load_library()


@pytest.mark.skipif(sys.platform != "linux", reason="a library that is there")
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, r"the native library is missing; run python tasks.py native, or pip install"),
        (b"no library", r"kernels-.*loaded"),
        (Path(mtrand.__file__).read_bytes(), r"kernels-.*loaded \(.*sources_hash\); run python tasks.py native"),
    ],
    ids=["missing", "damaged", "without our functions"],
)
def test_a_library_that_is_none_of_ours_names_the_command_that_builds_it(
    content: bytes | None, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for target in find_platform().targets if content else ():
        (tmp_path / find_platform().library_name(target)).write_bytes(content)
    monkeypatch.setenv("GSMERGE_NATIVE", str(tmp_path))
    with pytest.raises(UsageError, match=said):
        load_library()


def test_memory_that_does_not_suffice_for_the_library_is_called_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(path: str) -> None:
        raise OSError(f"{path}: failed to map segment from shared object")

    monkeypatch.setattr(module.ctypes, "CDLL", load)
    with pytest.raises(MemoryError):
        load_library()


def test_a_library_of_other_sources_names_the_command_that_builds_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "hash_sources", lambda: "0" * 16)
    with pytest.raises(UsageError, match=r"kernels-.*older"):
        load_library()


def test_library_of_a_wheel_is_loaded_without_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "hash_sources", lambda: "")
    assert ctypes.c_char_p.in_dll(load_library(), "sources_hash").value == hash_sources().encode()


def test_command_line_refuses_an_unknown_target_in_one_line(tmp_path: Path, small_scene: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gsmerge", "compact", str(small_scene), "-o", str(tmp_path / "x.ply")],
        capture_output=True, text=True, check=False, env={**os.environ, "GSMERGE_TARGET": "v5"},
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(f"{ERROR}GSMERGE_TARGET: ")


def test_tags_of_wheels_name_platform_targets_and_library() -> None:
    tags = {
        "manylinux_2_17_x86_64": Platform("linux", "x86_64"), "linux-aarch64": Platform("linux", "arm64"),
        "macosx_11_0_arm64": Platform("macosx", "arm64"), "macosx-10.13-x86_64": Platform("macosx", "x86_64"),
        "win_amd64": Platform("win", "x86_64"), "win-arm64": Platform("win", "arm64"),
    }  # fmt: skip
    assert {tag: find_platform(tag) for tag in tags} == tags
    assert Platform("linux", "x86_64").targets == (V3, V4)
    assert Platform("win", "arm64").targets == (ARM64,)
    assert Platform("win", "x86_64").library_name(V4) == "kernels-v4.dll"
    assert Platform("macosx", "arm64").library_name(ARM64) == "kernels-arm64.dylib"


def test_a_copied_folder_of_libraries_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for path in FOLDER.glob("kernels-*"):
        shutil.copy(path, tmp_path)
    monkeypatch.setenv("GSMERGE_NATIVE", str(tmp_path))
    assert Path(load_library()._name).parent == tmp_path
