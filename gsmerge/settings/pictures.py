"""List the endings of the files that ``gsmerge render`` writes."""

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
GIF = ".gif"
CLIPS = (".mp4", ".webm", GIF)
