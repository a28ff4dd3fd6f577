"""Inner loops: arrays in, arrays out, no torch, no files, no options; the loops themselves are in ``gsmerge/native``.

Every kernel is single-threaded, releases the GIL and is deterministic; callers run several at once on different
views (:mod:`gsmerge.runtime.threads`). Each has a slow, obvious twin in ``tests/kernels``.
"""
