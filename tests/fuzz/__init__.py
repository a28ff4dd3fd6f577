"""Readers of files, with small sound files of each format and ways to change these: python tasks.py fuzz."""
