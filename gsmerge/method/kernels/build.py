"""Build the native library of the kernels.

``pip install`` runs this file, and so does ``python tasks.py native`` after a change. This file runs before anything is
installed, so it needs only the standard library. The clang of the PyPI wheel ``ziglang`` builds every target.
``GSMERGE_CC`` names another compiler, whose rounding may differ.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from dataclasses import dataclass  # setup.py runs this file without the package
from pathlib import Path

FOLDER = Path(__file__).parent
FLAGS = (
    "-std=c11", "-O3", "-ffp-contract=on", "-fno-math-errno", "-ffreestanding", "-fPIC", "-fvisibility=hidden",
    "-Wall", "-Wextra", "-Werror", "-Wno-psabi", "-g0",
)  # fmt: skip
LINK = ("-shared", "-nostdlib")


@dataclass(frozen=True)
class Target:
    """A kind of processor for which a library is built."""

    name: str  # part of the library's file name, and a value of GSMERGE_TARGET
    zig: tuple[str, ...]  # options of the compiler if it is the clang of ziglang
    gcc: tuple[str, ...]  # options of other compilers, which take the options of GCC


V3 = Target("v3", ("-mcpu=x86_64_v3",), ("-march=x86-64-v3",))
# Vector gathers and scatters are off, because on many processors single loads and stores take less time
V4 = Target(
    "v4",
    ("-mcpu=x86_64_v4+prefer_no_gather+prefer_no_scatter", "-mprefer-vector-width=512"),
    ("-march=x86-64-v4", "-mprefer-vector-width=512"),
)
ARM64 = Target("arm64", (), ())


@dataclass(frozen=True)
class Platform:
    """An operating system and a family of processors. Each platform has one wheel."""

    system: str  # linux, macosx or win, as at the start of a wheel's tag
    machine: str  # x86_64 or arm64

    @property
    def suffix(self) -> str:
        """Suffix of library files, with its dot."""
        return {"macosx": ".dylib", "win": ".dll"}.get(self.system, ".so")

    @property
    def targets(self) -> tuple[Target, ...]:
        """Targets of the platform's processors, the one with the fewest instruction sets first."""
        return (V3, V4) if self.machine == "x86_64" else (ARM64,)

    @property
    def triple(self) -> str:
        """The target triple for the compiler. The C library that is part of the triple is not linked."""
        kind = "x86_64" if self.machine == "x86_64" else "aarch64"
        system = {"macosx": "macos.11.0", "win": "windows-gnu"}.get(self.system, "linux-gnu.2.17")
        return f"{kind}-{system}"

    @property
    def flags(self) -> tuple[str, ...]:
        """Further options of the compiler. On Windows they turn off stack probes, which would need a C library."""
        return ("-mno-stack-arg-probe",) if self.system == "win" else ()

    def library_name(self, target: Target) -> str:
        """Return the file name of a target's library."""
        return f"kernels-{target.name}{self.suffix}"


def find_platform(tag: str | None = None) -> Platform:
    """Return the platform of a wheel with a tag such as ``manylinux_2_17_aarch64``, by default of this machine."""
    name = (tag or sysconfig.get_platform()).lower()
    system = next((system for system in ("macosx", "win") if name.startswith(system)), "linux")
    return Platform(system, "arm64" if name.endswith(("arm64", "aarch64")) else "x86_64")


def source_files() -> list[Path]:
    """List the C sources and headers below this folder, sorted by name. A wheel may have none."""
    return sorted([*FOLDER.rglob("*.c"), *FOLDER.rglob("*.h")], key=lambda path: path.name)


def hash_sources() -> str:
    """Return a hash of the names and contents of all sources, or an empty string without sources."""
    digest = hashlib.sha256()
    paths = source_files()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16] if paths else ""


def compiler() -> list[str]:
    """Return the words of the command that runs the compiler, or raise OSError if there is none."""
    words = shlex.split(os.environ.get("GSMERGE_CC", ""))
    if words:
        program = shutil.which(words[0])
        if program is None:
            raise OSError(f"GSMERGE_CC: expected a compiler, found no program {words[0]!r}")
        return [os.path.abspath(program), *words[1:]]
    try:
        import ziglang
    except ImportError:
        raise OSError("expected the compiler of the package ziglang, found none; run pip install ziglang") from None
    return [str(Path(ziglang.__path__[0]) / ("zig.exe" if os.name == "nt" else "zig")), "cc"]


def build_target(
    target: Target, folder: Path, platform: Platform, extra: tuple[str, ...] = (), link: tuple[str, ...] = LINK
) -> Path:
    """Build the library of a target into a folder, and return its path.

    Raises OSError with the message of the compiler if it fails.
    """
    command = compiler()
    path = folder / platform.library_name(target)
    is_zig = Path(command[0]).stem == "zig"
    options = ["-target", platform.triple, *platform.flags, *target.zig] if is_zig else target.gcc
    with tempfile.TemporaryDirectory() as cache:
        built = Path(cache) / path.name
        caches = {"ZIG_GLOBAL_CACHE_DIR": f"{cache}/global", "ZIG_LOCAL_CACHE_DIR": f"{cache}/local"}
        call = [
            *command, *options, *FLAGS, f'-DSOURCES_HASH="{hash_sources()}"', *extra, *link,
            *(f"-I{folder}" for folder in sorted({path.parent for path in source_files()})),
            *(str(path) for path in source_files() if path.suffix == ".c"), "-o", built.name,  # macOS stores this name
        ]  # fmt: skip
        run = subprocess.run(call, cwd=cache, env={**os.environ, **caches}, capture_output=True, text=True, check=False)
        if run.returncode:
            raise OSError(f"{command[0]}: building {path.name} failed\n{run.stderr[-4000:]}")
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(built, f"{path}.new")
        os.replace(f"{path}.new", path)
    return path


def build_libraries(
    folder: Path = FOLDER, extra: tuple[str, ...] = (), platform: str | None = None, link: tuple[str, ...] = LINK
) -> list[Path]:
    """Build the libraries of all targets of a platform into a folder, and return their paths.

    Args:
        folder: Folder of the libraries.
        extra: Further options of the compiler.
        platform: Tag of the wheel that gets the libraries, by default one for this machine.
        link: Options of the compiler that link a library.
    """
    from concurrent.futures import ThreadPoolExecutor  # here because it takes some milliseconds, which runs save

    wheel_platform = find_platform(platform)
    with ThreadPoolExecutor() as pool:
        targets = wheel_platform.targets
        return list(pool.map(lambda target: build_target(target, folder, wheel_platform, extra, link), targets))


if __name__ == "__main__":
    try:
        for built in build_libraries():
            print(built)
    except OSError as error:
        sys.exit(str(error))
