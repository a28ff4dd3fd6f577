"""The process: threads, memory, logs, and what a run will take."""
