"""Run the inner loops of the package on arrays, without torch, files or options.

The loops are written in C. Each C file lies beside the Python file that declares its functions.

Every kernel uses a single thread, releases the GIL and is deterministic. Callers run several kernels at once on
different views (:mod:`gsmerge.runtime.threads`). Tests in ``tests/kernels`` compare each kernel with a slow and obvious
function.

The sources are plain C11 with vectors of sixteen floats, without globals, allocations or libraries. The compiler may
not reassociate sums, and fuses a product with a sum only where the source says so. For these reasons every processor
and every number of threads gives the same bits.
"""
