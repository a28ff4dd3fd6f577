"""The loops that matter for time, in C: one file for each file of :mod:`gsmerge.kernels`, which calls them.

Plain C11 with vectors of sixteen floats, no globals, no allocation, no library. Nothing is reassociated and products
are contracted as the source says, so every processor and every number of threads gives the same bits.
"""
