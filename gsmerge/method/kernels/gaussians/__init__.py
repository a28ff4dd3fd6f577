"""Compute with the parameters of Gaussians, without drawing them."""
