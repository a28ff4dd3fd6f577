"""Geometry of Gaussians and cameras: rotations, projection, similarities, the canonical frame, pooling."""
