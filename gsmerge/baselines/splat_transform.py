"""PlayCanvas' splat-transform, an installed program: its merge decimation on the CPU, by its own defaults.

Nothing is downloaded. Only the program's own run counts as time, start-up included; handing the Gaussians over and
back does not.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from gsmerge.baselines.baseline import own_gaussians
from gsmerge.errors import GsmergeError, UsageError
from gsmerge.io import read_ply, write_ply
from gsmerge.plan import Plan
from gsmerge.runtime.record import stage
from gsmerge.stages.prepare import Prepared
from gsmerge.types import Gaussians

PROGRAM, VARIABLE = "splat-transform", "GSMERGE_SPLAT_TRANSFORM"
INSTALL = "npm install -g @playcanvas/splat-transform@3.7.0"
MAX_OUTPUT = 300  # characters of the program's own output in an error


def find_program() -> str:
    """Path of the program; a UsageError if there is none."""
    named = os.environ.get(VARIABLE)
    program = shutil.which(named or PROGRAM)
    if program is None:
        place = f"at {VARIABLE}={named}" if named else f"on PATH or named by {VARIABLE}"
        problem = f"expected the program {place}, found none; install it with: {INSTALL}"
        raise UsageError(f"method splat-transform: {problem}")
    return program


def run(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Exactly as many as the program makes of ``-d COUNT``; the input itself where it has no more than that."""
    gaussians, program = own_gaussians(prepared.scene), find_program()
    if len(gaussians) <= count:
        return gaussians
    with tempfile.TemporaryDirectory(prefix="gsmerge-") as folder:
        before, after = Path(folder) / "in.ply", Path(folder) / "out.ply"
        write_ply(before, gaussians)
        command = [program, "-w", "-g", "cpu", str(before), "-d", str(count), str(after)]
        with stage("reduce"):
            done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
        if done.returncode != 0 or not after.exists():
            output = " ".join((done.stderr or done.stdout).decode(errors="replace").split())[-MAX_OUTPUT:]
            problem = f"expected a decimated .ply, it ended with code {done.returncode}: {output or 'without output'}"
            raise GsmergeError(f"{program}: {problem}")
        return read_ply(after, opacity="logit").gaussians
