"""Targets of the native library: which of them this processor runs."""

from __future__ import annotations

import os
from contextlib import suppress
from unittest import mock

from gsmerge.errors import UsageError
from gsmerge.method.kernels.build import find_platform
from gsmerge.method.kernels.library import load_library


def runnable_targets() -> list[str]:
    """Return the names of the targets whose library loads here, the most advanced one last."""
    names = []
    for target in find_platform().targets:
        load_library.cache_clear()
        with mock.patch.dict(os.environ, GSMERGE_TARGET=target.name), suppress(UsageError):
            load_library()
            names.append(target.name)
    load_library.cache_clear()
    return names
