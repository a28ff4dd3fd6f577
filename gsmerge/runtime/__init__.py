"""The process: threads, memory, records, and estimates of time and memory."""
