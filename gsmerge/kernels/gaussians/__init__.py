"""Kernels on Gaussians and their parameters."""
