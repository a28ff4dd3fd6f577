"""Readers of camera files, one module per format."""
