"""The running process: threads, memory, records, and estimates of time and memory."""

MOST_THREADS = 1024  # each takes memory, even if it never has work
