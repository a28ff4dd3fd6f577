"""The build works for every platform and other compilers, and says where it cannot."""

from __future__ import annotations

import ctypes
import shutil
import sys
from pathlib import Path

import pytest
from messages import refuses
from scripts import load_script

from gsmerge.method.kernels import build as module
from gsmerge.method.kernels.build import Platform, build_libraries, compiler, find_platform, hash_sources

HEADS = {"linux": b"\x7fELF", "macosx": b"\xcf\xfa\xed\xfe", "win": b"MZ"}
PLATFORMS = (
    "win_arm64", "manylinux_2_17_x86_64", "manylinux_2_17_aarch64", "macosx_11_0_arm64", "macosx_10_13_x86_64",
    "win_amd64",
)  # fmt: skip


def check_libraries(paths: list[Path], where: Platform) -> None:
    """Check names, formats, functions and hash of a platform's libraries."""
    assert [path.name for path in paths] == [where.library_name(target) for target in where.targets]
    for path in paths:
        content = path.read_bytes()
        assert content.startswith(HEADS[where.system])
        assert all(name in content for name in (b"blend_backward", b"sources_hash", hash_sources().encode()))


def test_the_installation_has_built_the_libraries_of_this_platform() -> None:
    where = find_platform()
    check_libraries([module.FOLDER / where.library_name(target) for target in where.targets], where)


# In the sweeps each system and family of processors once; the others, of the same, before a release
SWEPT = ("macosx_11_0_arm64", "win_amd64")


@pytest.mark.parametrize(
    "tag",
    [
        pytest.param(tag, marks=pytest.mark.slow if tag in SWEPT else pytest.mark.release)
        for tag in PLATFORMS
        if find_platform(tag) != find_platform()
    ],
)
def test_libraries_of_every_other_platform_are_built_here(tag: str, tmp_path: Path) -> None:
    paths = build_libraries(tmp_path, platform=tag)
    check_libraries(paths, find_platform(tag))
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    if tag == "macosx_11_0_arm64":  # of one target, which takes the least time
        assert [path.read_bytes() for path in build_libraries(tmp_path / "again", platform=tag)] == [
            paths[0].read_bytes()
        ]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "darwin" or shutil.which("gcc") is None, reason="needs gcc, not clang by its name")
def test_another_compiler_can_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_CC", "gcc -Wno-error")
    for path in build_libraries(tmp_path):
        assert ctypes.c_char_p.in_dll(ctypes.CDLL(str(path)), "sources_hash").value == hash_sources().encode()


def test_missing_compiler_of_the_variable_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_CC", "no-such-compiler -O2")
    with refuses(OSError, "GSMERGE_CC", "'no-such-compiler'"):
        build_libraries(tmp_path)


def test_failed_build_shows_the_compiler_s_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"(?s)building kernels-.* failed\n.*error:"):
        build_libraries(tmp_path, ("-include", "no-such-header.h"))
    assert list(tmp_path.iterdir()) == []


def test_without_a_compiler_the_error_names_the_package_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GSMERGE_CC", raising=False)
    monkeypatch.setitem(module.sys.modules, "ziglang", None)
    with refuses(OSError, "", "ziglang", "none"):
        compiler()


def test_a_failed_build_keeps_the_libraries_of_an_earlier_one(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As pip builds for an editable installation, which would have none otherwise."""
    monkeypatch.setattr(pytest.importorskip("setuptools"), "setup", lambda **_: None)
    script = load_script(root / "setup.py")
    command = script.BuildNative(script.NativeDistribution())
    command.editable_mode = True
    monkeypatch.setattr(script.native_build, "FOLDER", tmp_path)
    earlier, new = tmp_path / "kernels-v3.so", tmp_path / "kernels-v4.so"
    earlier.touch()

    def fail(*_: object, **__: object) -> list[Path]:
        raise OSError("no compiler")

    monkeypatch.setattr(script.native_build, "build_libraries", fail)
    with pytest.raises(OSError, match="no compiler"):
        command.run()
    assert list(tmp_path.iterdir()) == [earlier]
    monkeypatch.setattr(script.native_build, "build_libraries", lambda *_, **__: (new.touch(), [new])[1])
    command.run()
    assert list(tmp_path.iterdir()) == [new]
