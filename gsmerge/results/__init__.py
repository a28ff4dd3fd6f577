"""Filled -> result: candidates and their scores, the report, and the files of an output."""
