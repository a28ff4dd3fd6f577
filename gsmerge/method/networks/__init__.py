"""Networks of the paper, whose outputs are bounded corrections of the analytic stages, and their checkpoints.

The paper is "Compact Feed-Forward 3D Gaussians via Saliency-Guided Primitive Merging".
"""
