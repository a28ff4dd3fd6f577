"""Encode once, decode many: the merged Feature Gaussians of a scene, kept in a file that needs no images any more."""

from gsmerge.stored.encoded import Division, Encoded, StoredHeads, StoredSettings
from gsmerge.stored.file import load_encoded, save_encoded
from gsmerge.stored.stage import Plan, decode_scene, encode_scene, plan_decode

__all__ = [
    "Division",
    "Encoded",
    "Plan",
    "StoredHeads",
    "StoredSettings",
    "decode_scene",
    "encode_scene",
    "load_encoded",
    "plan_decode",
    "save_encoded",
]
