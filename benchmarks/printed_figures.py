"""Figures that the superpixel merging paper prints: PSNR / SSIM / LPIPS, means over its three benchmarks.

Means over the benchmarks that the paper does not print itself are computed from its columns.
"""

from __future__ import annotations

Rows = dict[str, tuple[str, ...]]

# With Depth Anything 3, its strongest backbone, with poses. Share kept; 3, 6, 9, 12 views; their mean.
VIEWS: Rows = {
    "input": ("100%", "16.77/0.576/0.306", "16.42/0.552/0.340", "16.90/0.546/0.346",
              "17.18/0.540/0.351", "16.82/0.554/0.336"),
    "moments": ("4.9%", "13.52/0.492/0.574", "13.46/0.477/0.603", "13.43/0.458/0.634",
                "13.41/0.445/0.654", "13.46/0.468/0.616"),
    "k1": ("4.4%", "17.58/0.575/0.404", "17.07/0.554/0.425", "17.41/0.543/0.439",
           "17.58/0.534/0.446", "17.41/0.552/0.429"),
}  # fmt: skip
# DA3; DepthSplat; AnySplat's own voxels, shares of its pixels.
BACKBONES: Rows = {
    "input": ("16.82/0.554/0.335", "14.49/0.535/0.371", "83.8%: 12.69/0.377/0.487"),
    "moments": ("4.9%: 13.46/0.468/0.616", "6.1%: 12.31/0.463/0.564", ""),
    "k1": ("4.4%: 17.41/0.551/0.428", "5.3%: 15.62/0.498/0.451",
           "3.6%: 14.09/0.424/0.528"),
    "k4": ("17.3%: 17.56/0.556/0.424", "21.1%: 16.20/0.512/0.445",
           "14.3%: 14.58/0.436/0.524"),
}  # fmt: skip
# AnySplat with K = 1, by the size of superpixels or by variant.
SIZES = {"2.2%": "2.0%: 13.97/0.424/0.548", "5.3%": "4.4%: 14.14/0.423/0.533", "10.2%": "8.7%: 14.11/0.420/0.523"}
ABLATION = {
    "the whole": "14.14/0.423/0.533",
    "without the refiner": "13.49/0.389/0.534 (-0.65)",
    "no merging across views": "14.13/0.424/0.531 (-0.01)",
    "larger superpixels": "13.97/0.424/0.548 (-0.17)",
    "smaller superpixels": "14.11/0.420/0.523 (-0.03)",
}
