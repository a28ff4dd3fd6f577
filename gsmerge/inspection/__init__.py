"""Inspection of files: what they hold, whether they are sound, and what compact would make of them."""
