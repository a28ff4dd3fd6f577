"""Facts about a scene before the first stage: its frame, photos, exposures, poses, views and holes."""
