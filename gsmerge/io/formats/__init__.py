"""File formats of Gaussians, one module each."""
