"""Scripts of examples/ and benchmarks/ are loaded as modules."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).parents[2] / "examples"


def load_script(path: Path) -> ModuleType:
    """Load a script as a module; its name may start with a digit."""
    name = f"script_{path.stem}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def target_psnr(targets: Path, ply: Path) -> float:
    """Return the PSNR of a result on held-out photos, as the measuring example computes it, dB."""
    measured: float = load_script(EXAMPLES / "03_measure_targets.py").target_psnr(targets, ply)
    return measured
