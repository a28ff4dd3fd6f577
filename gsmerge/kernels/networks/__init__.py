"""Layers of the networks, what they read, and the corrections that they make."""
