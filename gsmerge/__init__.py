"""Compact feed-forward 3D Gaussian scenes: 1 to 10 % of the Gaussians, seconds on a CPU.

    import gsmerge

    scene = gsmerge.read_scene("scene.ply")
    result = gsmerge.compact(scene, k=2)
    gsmerge.write_ply("scene.compact.ply", result.gaussians)

Everything public is here and loads at first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsmerge.version import __version__

if TYPE_CHECKING:
    from gsmerge import integrations as integrations
    from gsmerge.drawing.pages.view import view as view
    from gsmerge.drawing.render_views import render as render
    from gsmerge.errors import DoubtWarning as DoubtWarning
    from gsmerge.errors import GsmergeError as GsmergeError
    from gsmerge.errors import SceneError as SceneError
    from gsmerge.io import read_cameras as read_cameras
    from gsmerge.io import read_gaussians as read_gaussians
    from gsmerge.io import read_ply as read_ply
    from gsmerge.io import to_cameras as to_cameras
    from gsmerge.io import write_gaussians as write_gaussians
    from gsmerge.io import write_ply as write_ply
    from gsmerge.io.formats.streamed import write_levels as write_levels
    from gsmerge.jobs.inspect import inspect as inspect
    from gsmerge.jobs.states.compactor import Compactor as Compactor
    from gsmerge.jobs.tensors import compact_tensors as compact_tensors
    from gsmerge.method.raster import Rendering as Rendering
    from gsmerge.method.stages.superpixels import saliency as saliency
    from gsmerge.method.stages.superpixels import superpixels as superpixels
    from gsmerge.reading.held_out import read_held_out as read_held_out
    from gsmerge.reading.read_scene import load_scene as load_scene
    from gsmerge.reading.read_scene import read_scene as read_scene
    from gsmerge.results.report import CompactReport as CompactReport
    from gsmerge.results.result import CompactResult as CompactResult
    from gsmerge.run import compact as compact
    from gsmerge.scoring.evaluate import Evaluation as Evaluation
    from gsmerge.scoring.evaluate import evaluate as evaluate
    from gsmerge.settings.compact import CompactOptions as CompactOptions
    from gsmerge.settings.evaluate import EvaluateOptions as EvaluateOptions
    from gsmerge.types import Cameras as Cameras
    from gsmerge.types import Gaussians as Gaussians
    from gsmerge.types import Scene as Scene
    from gsmerge.types import Views as Views

_PUBLIC = {
    "run": ("compact",),
    "jobs.inspect": ("inspect",),
    "results.report": ("CompactReport",),
    "results.result": ("CompactResult",),
    "jobs.tensors": ("compact_tensors",),
    "errors": ("DoubtWarning", "GsmergeError", "SceneError"),
    "io": ("read_cameras", "read_gaussians", "read_ply", "to_cameras"),
    "io.formats.streamed": ("write_levels",),
    "io.formats.write": ("write_gaussians", "write_ply"),
    "scoring.evaluate": ("Evaluation", "evaluate"),
    "drawing.pages.view": ("view",),
    "jobs.states.compactor": ("Compactor",),
    "drawing.render_views": ("render",),
    "method.raster": ("Rendering",),
    "reading.held_out": ("read_held_out",),
    "reading.read_scene": ("load_scene", "read_scene"),
    "settings.compact": ("CompactOptions",),
    "settings.evaluate": ("EvaluateOptions",),
    "method.stages.superpixels": ("saliency", "superpixels"),
    "types": ("Cameras", "Gaussians", "Scene", "Views"),
}
_HINTS = {
    "load": "read_scene or read_gaussians",
    "read": "read_scene or read_gaussians",
    "open": "read_scene or read_gaussians",
    "convert": "read_gaussians and write_gaussians",
    "save": "the .save(path) of a result, or write_gaussians",
}
_EXPORTS = {name: home for home, names in _PUBLIC.items() for name in names}

__all__ = ["__version__", *sorted(_EXPORTS)]  # noqa: PLE0604 - strings all, from the table above


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name == "integrations":
        return import_module(f"{__name__}.{name}")
    if name not in _EXPORTS:
        hint = f"; use {_HINTS[name]}" if name in _HINTS else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "integrations"})
