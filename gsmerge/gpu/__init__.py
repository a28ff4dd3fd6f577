"""The fit, its growth, colours and scores on a GPU: plain functions on tensors of any device.

Merging stays on the CPU. Nothing here is imported before ``--device`` resolves to CUDA. On the torch CPU device every
function gives what the kernels give, which is how it is tested; docs/internals/gpu.md says what differs on a GPU.
"""
