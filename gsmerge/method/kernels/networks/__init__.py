"""Compute the layers of the networks, their inputs, and the corrections that follow from their outputs."""
