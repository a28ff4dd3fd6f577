"""Read and write the file formats of Gaussians, each in its own module."""
