"""Measure quality, size and speed, and draw pictures for people."""
