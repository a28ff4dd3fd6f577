"""Experiments over a grid of settings, what they measured, and charts and a page of it."""
