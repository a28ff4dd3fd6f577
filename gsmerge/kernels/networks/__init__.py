"""Kernels of the networks: their layers, their inputs, and the corrections that they output."""
