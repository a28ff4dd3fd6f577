"""Experiments over a grid of settings, their measurements, and charts and a page of them."""
