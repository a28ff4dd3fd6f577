"""Inner loops: arrays in, arrays out, no torch, no files, no options. The loops are in C, each beside its declaration.

Every kernel is single-threaded, releases the GIL and is deterministic; callers run several at once on different
views (:mod:`gsmerge.runtime.threads`). Each has a slow, obvious twin in ``tests/kernels``.

The sources are plain C11 with vectors of sixteen floats, no globals, no allocation, no library. Nothing is reassociated
and products are contracted as the source says, so every processor and every number of threads gives the same bits.
"""
