"""The paper's networks as bounded corrections of the analytic stages, and their checkpoints."""

from gsmerge.networks.apply import (
    NetworkContext,
    decode_gaussians,
    decode_with_group_features,
    encode_features,
    match_geometry,
    merge_features,
    refine_features,
)
from gsmerge.networks.checkpoint import Checkpoint, find_checkpoint, load_checkpoint, save_checkpoint
from gsmerge.networks.modules import Networks
from gsmerge.networks.options import Bounds, NetworkOptions
from gsmerge.networks.tokens import make_group_features

__all__ = [
    "Bounds",
    "Checkpoint",
    "NetworkContext",
    "NetworkOptions",
    "Networks",
    "decode_gaussians",
    "decode_with_group_features",
    "encode_features",
    "find_checkpoint",
    "load_checkpoint",
    "make_group_features",
    "match_geometry",
    "merge_features",
    "refine_features",
    "save_checkpoint",
]
