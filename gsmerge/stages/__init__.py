"""The stages of a run, each in a file of its own. Functions that several stages use are in packages below this one.

Comments call "Compact Feed-Forward 3D Gaussians via Saliency-Guided Primitive Merging" the paper.
"""
