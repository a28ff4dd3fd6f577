"""Find the number of Gaussians: for a quality, by the curve of a scene, for a file size, or with clean-up."""
