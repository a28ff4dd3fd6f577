"""Read scenes from files: find the files that belong together, know exporters, read views and held-out views."""
