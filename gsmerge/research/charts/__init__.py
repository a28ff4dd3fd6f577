"""Runs over a grid of settings as jobs of a batch, and figures and a page of their measurements."""
