"""Load the native library that fits the processor."""

from __future__ import annotations

import ctypes
import os
from functools import lru_cache
from pathlib import Path

from gsmerge.errors import UsageError, is_out_of_memory
from gsmerge.method.kernels.build import FOLDER, Target, find_platform, hash_sources

REMEDY = "run python tasks.py native, or pip install again"


@lru_cache(maxsize=1)
def load_library() -> ctypes.CDLL:
    """Return the native library, in the version of the most advanced target that this processor runs.

    The environment variable ``GSMERGE_TARGET`` names another target, and ``GSMERGE_NATIVE`` another folder of
    libraries. Raises UsageError if no library fits the processor, or if the library is missing or older than its
    sources.
    """
    targets = {target.name: target for target in _runnable_targets()}
    name = os.environ.get("GSMERGE_TARGET") or list(targets)[-1]
    if name not in targets:
        raise UsageError(f"GSMERGE_TARGET: expected {' or '.join(targets)} on this processor, found {name!r}; unset it")
    return _open_library(targets[name])


def _runnable_targets() -> list[Target]:
    """Return the targets that this processor runs, the most advanced one last, or raise UsageError if there is none."""
    basic, *advanced = find_platform().targets
    if basic.name == "arm64":
        return [basic]
    library = _open_library(basic)  # its function processor_level runs on every processor
    level = library.processor_level()
    if level < 3:
        raise UsageError("expected a processor with AVX2 and FMA (x86-64-v3, from 2013 on), found an older one")
    return [basic, *(target for target in advanced if level >= int(target.name[1:]))]  # "v4" needs level 4


@lru_cache
def _open_library(target: Target) -> ctypes.CDLL:
    """Load the library of a target, or raise UsageError if it is missing, damaged, or older than the sources."""
    folder = Path(os.environ.get("GSMERGE_NATIVE") or FOLDER)
    path = folder / find_platform().library_name(target)
    try:
        library = ctypes.CDLL(str(path))
        sources_hash = ctypes.c_char_p.in_dll(library, "sources_hash").value or b""
    except (OSError, ValueError) as error:  # ValueError if the library is not one of this package
        if is_out_of_memory(error):
            raise MemoryError from error
        if path.exists():
            raise UsageError(f"{path}: the native library cannot be loaded ({error}); {REMEDY}") from None
        raise UsageError(f"{path}: the native library is missing; {REMEDY}") from None
    if hash_sources().encode() not in (b"", sources_hash):
        raise UsageError(f"{path}: the native library is older than its sources; {REMEDY}")
    return library
