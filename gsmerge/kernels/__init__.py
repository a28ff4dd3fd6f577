"""Run the inner loops on arrays: no torch, no files, no options. The loops are in C, each beside its declaration.

Every kernel uses a single thread, releases the GIL and is deterministic. Callers run several kernels at once on
different views (:mod:`gsmerge.runtime.threads`). Each kernel has a slow, obvious twin in ``tests/kernels``.

The sources are plain C11 with vectors of sixteen floats, without globals, allocations or libraries. The compiler may
not reassociate sums, and fuses a product with a sum only where the source says so. So every processor and every number
of threads gives the same bits.
"""
