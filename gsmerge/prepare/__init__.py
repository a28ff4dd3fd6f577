"""Scene -> prepared scene: its canonical frame, pictures of its views, exposures, poses, pixels, depths and holes."""
