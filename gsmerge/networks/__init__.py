"""The paper's networks as bounded corrections of the analytic stages, and the checkpoints that hold them."""

from gsmerge.networks.apply import (
    Learned,
    decode_described,
    decode_gaussians,
    encode_features,
    match_geometry,
    merge_features,
    refine_features,
)
from gsmerge.networks.checkpoint import Checkpoint, find_checkpoint, load_checkpoint, save_checkpoint
from gsmerge.networks.modules import Networks
from gsmerge.networks.options import Bounds, NetworkOptions
from gsmerge.networks.tokens import described_by

__all__ = [
    "Bounds",
    "Checkpoint",
    "Learned",
    "NetworkOptions",
    "Networks",
    "decode_described",
    "decode_gaussians",
    "described_by",
    "encode_features",
    "find_checkpoint",
    "load_checkpoint",
    "match_geometry",
    "merge_features",
    "refine_features",
    "save_checkpoint",
]
