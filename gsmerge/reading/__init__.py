"""Read scenes from files: find the files that belong together, align rows with cameras, and find their photos."""
