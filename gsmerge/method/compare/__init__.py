"""Compare pictures in memory: photos with what Gaussians show."""
