"""Compare photos with what Gaussians show; all scores are relative to the noise of wrong pairs."""
