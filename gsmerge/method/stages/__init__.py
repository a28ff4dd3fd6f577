"""The stages of a run, with a file for each. Functions that several stages use are in packages below this one.

Comments call "Compact Feed-Forward 3D Gaussians via Saliency-Guided Primitive Merging" the paper.
"""
