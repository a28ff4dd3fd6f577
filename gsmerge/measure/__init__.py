"""Measuring: quality, size, speed, and pictures for people."""
