"""Runs that leave the road: searches, budgets in bytes, clean-up, blocks, new views, and methods of others."""
