"""Encoded scenes: the merged Feature Gaussians of a scene, in a file that needs no images any more.

Nothing is imported here, so that decoding loads none of the stages before it.
"""
