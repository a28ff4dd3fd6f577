"""The paper's networks as bounded corrections of the analytic stages, and their checkpoints.

They load at first use, so that their modules without torch, such as :mod:`gsmerge.networks.neighbors`, do without it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsmerge.networks.apply import NetworkContext as NetworkContext
    from gsmerge.networks.apply import decode_gaussians as decode_gaussians
    from gsmerge.networks.apply import decode_with_group_features as decode_with_group_features
    from gsmerge.networks.apply import encode_features as encode_features
    from gsmerge.networks.apply import match_geometry as match_geometry
    from gsmerge.networks.apply import merge_features as merge_features
    from gsmerge.networks.apply import refine_features as refine_features
    from gsmerge.networks.checkpoint import Checkpoint as Checkpoint
    from gsmerge.networks.checkpoint import find_checkpoint as find_checkpoint
    from gsmerge.networks.checkpoint import load_checkpoint as load_checkpoint
    from gsmerge.networks.checkpoint import save_checkpoint as save_checkpoint
    from gsmerge.networks.modules import Networks as Networks
    from gsmerge.networks.options import Bounds as Bounds
    from gsmerge.networks.options import NetworkOptions as NetworkOptions
    from gsmerge.networks.tokens import make_group_features as make_group_features

_PUBLIC = {
    "apply": (
        "NetworkContext", "decode_gaussians", "decode_with_group_features", "encode_features", "match_geometry",
        "merge_features", "refine_features",
    ),
    "checkpoint": ("Checkpoint", "find_checkpoint", "load_checkpoint", "save_checkpoint"),
    "modules": ("Networks",),
    "options": ("Bounds", "NetworkOptions"),
    "tokens": ("make_group_features",),
}  # fmt: skip
_EXPORTS = {name: home for home, names in _PUBLIC.items() for name in names}

__all__ = sorted(_EXPORTS)  # noqa: PLE0605 - strings all, from the table above


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value
