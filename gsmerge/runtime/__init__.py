"""Threads, processes and memory of a run, its record, and its plugins."""

MOST_THREADS = 1024  # because each thread takes memory, even if it never has work
