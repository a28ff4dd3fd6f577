"""The pipeline on a GPU: plain functions on tensors of any device, one file for each arrow.

Nothing here is imported before ``--device`` resolves to CUDA. On the torch CPU device every function gives what the
stage of the same name gives, which is how it is tested. How it works and what differs: docs/internals/gpu.md.
"""
