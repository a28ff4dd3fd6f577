"""Kernels of the rasterizer."""
