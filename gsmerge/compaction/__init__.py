"""The way from a scene to a result: one piece or blocks, one count or a search, from files or from memory."""
