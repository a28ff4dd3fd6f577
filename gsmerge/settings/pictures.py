"""Endings of the names of files that ``gsmerge render`` can write."""

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
GIF = ".gif"
CLIPS = (".mp4", ".webm", GIF)
