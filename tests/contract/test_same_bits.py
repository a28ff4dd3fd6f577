"""What computes results calls nothing whose bits depend on the processor.

NumPy, its BLAS and OpenCV choose code by processor, and the last bits of these functions with it; `kernels.elementary`,
`kernels.matrices` and `kernels.pictures` take their places. Sums, square roots, medians and products of whole arrays
are safe, and so is the rest of OpenCV that is in use (tests/e2e/test_same_bytes.py).
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ELEMENTARY = (
    "exp exp2 expm1 log log2 log10 log1p power float_power sin cos tan sinh cosh tanh arcsin arccos arctan arctan2"
    " arcsinh arccosh arctanh cbrt hypot logaddexp"
)
PRODUCTS = "dot vdot inner matmul tensordot einsum corrcoef cov polyfit convolve correlate"
LINEAR = "inv pinv det solve svd eig eigh eigvals eigvalsh lstsq qr cholesky matrix_power matrix_rank"
OPENCV = (
    "GaussianBlur Sobel Scharr Laplacian blur boxFilter filter2D sepFilter2D cornerMinEigenVal cornerHarris remap"
    " Rodrigues calibrateCamera solvePnPRefineLM solvePnPRefineVVS SVDecomp solve invert INTER_CUBIC COLOR_RGB2GRAY"
)
REFUSED = {
    *(f"np.{name}" for name in (ELEMENTARY + " " + PRODUCTS).split()),
    *(f"np.linalg.{name}" for name in LINEAR.split()),
    *(f"cv2.{name}" for name in OPENCV.split()),
}
# What computes no result: pages and pictures for people, research.
OTHERS = (
    "pages/",
    "research/",
    "measure/clip.py",
    "measure/lpips.py",
    "measure/preview.py",
    "networks/tensors.py",
)
ALLOWED = {
    ("io/cameras/camera_file.py", "cv2.remap"),  # of bytes: whole numbers
    ("alignment/registration/keypoints.py", "@"),  # of whole numbers below 2^24, which float32 has exactly
}


def dotted(node: ast.expr) -> str:
    """The name of an attribute with those in front of it, such as ``np.linalg.inv``."""
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def refused_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            yield "@"
        elif isinstance(node, ast.Attribute) and dotted(node) in REFUSED:
            yield dotted(node)


def test_nothing_depends_on_the_processor(root: Path) -> None:
    package, found = root / "gsmerge", set()
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package).as_posix()
        if not name.startswith(OTHERS):
            found |= {(name, what) for what in refused_names(ast.parse(path.read_text(encoding="utf-8")))}
    assert found == ALLOWED


def test_what_is_refused_is_seen() -> None:
    tree = ast.parse("a = b @ c\nd = np.linalg.inv(a) + np.exp(a)\ncv2.resize(a, interpolation=cv2.INTER_CUBIC)")
    assert set(refused_names(tree)) == {"@", "np.linalg.inv", "np.exp", "cv2.INTER_CUBIC"}
