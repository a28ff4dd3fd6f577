"""Compaction of a scene: in one piece or in blocks, by one count or a search, from files or from memory."""
