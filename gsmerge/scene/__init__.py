"""Scenes from files: the files that belong together, their exporters' habits, views and held-out views."""
