"""What computes results, and what makes the data of tests, calls nothing whose bits depend on the processor.

NumPy, its BLAS and OpenCV choose code by processor, and the last bits of these functions with it; `kernels.elementary`,
`kernels.matrices` and `kernels.pictures` take their places. Sums, square roots, medians and products of whole arrays
are safe, and so is the rest of OpenCV that is in use (tests/e2e/test_same_bytes.py).
"""

from __future__ import annotations

import ast
import re
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
# A file without any of it is not worth parsing; the formatter puts a space or "=" behind the sign of a product
REFUSED_IN_TEXT = rf"@[ =]|\.({'|'.join(sorted({name.rpartition('.')[2] for name in REFUSED}))})\b"
# What computes no result: pages and pictures for people, research.
OTHERS = (
    "drawing/pages/",
    "drawing/clip.py",
    "drawing/preview.py",
    "research/",
    "scoring/lpips.py",
    "method/networks/tensors.py",
)
ALLOWED = {
    ("io/cameras/camera_file.py", "cv2.remap"),  # of bytes: whole numbers
    ("reading/alignment/registration/keypoints.py", "@"),  # of whole numbers below 2^24, which float32 has exactly
}


def dotted(node: ast.expr) -> str:
    """Return the name of an attribute with those in front of it, such as ``np.linalg.inv``."""
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def refused_here(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
        yield "@"
    elif isinstance(node, ast.Attribute) and dotted(node) in REFUSED:
        yield dotted(node)


def refused_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        yield from refused_here(node)


def test_package_calls_nothing_that_depends_on_the_processor(root: Path) -> None:
    found = set()
    for path, tree in python_files(root, "gsmerge", having=REFUSED_IN_TEXT):
        name = path.removeprefix("gsmerge/")
        if not name.startswith(OTHERS):
            found |= {(name, what) for what in refused_names(tree)}
    assert found == ALLOWED


# What makes data: tests' own helpers, the generator, the example that makes a scene
MAKERS = ("tests/helpers", "tests/damage", "gsmerge/research/generate", "examples/01_make_scene.py")
ALLOWED_MAKERS = {
    ("gsmerge/research/generate/photograph.py", "cv2.remap"),  # bilinear: the same without AVX2 and AVX-512
    ("gsmerge/research/generate/textures.py", "cv2.remap"),
    ("tests/helpers/model_rows.py", "cv2.INTER_CUBIC"),  # of bytes: whole numbers
    ("tests/helpers/slow_renderer.py", "@"),  # of tensors: a twin, no data
}
SUSPECT = rf"\b(np|math)\.a?({'|'.join(ELEMENTARY.split())}|cos|sin|tan)|\barg(sort|partition)|order="  # worth parsing
TWIN = "tests/kernels/test_elementary.py"  # compares NumPy's functions with ours


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Return all nodes but those of assertions, where an expectation may have another last bit."""
    waiting = [node]
    while waiting:
        for child in ast.iter_child_nodes(waiting.pop()):
            name = dotted(child.func).rpartition(".")[2] if isinstance(child, ast.Call) else ""
            if not isinstance(child, ast.Assert) and not name.startswith("assert_") and name != "approx":
                yield child
                waiting.append(child)


def refused_data(tree: ast.AST) -> Iterator[str]:
    """Return elementary functions of NumPy and of the system, and sorts that leave ties in any order."""
    elementary = {f"{module}.{name}" for module in ("np", "math") for name in ELEMENTARY.split()}
    elementary |= {f"math.{name}" for name in ("pow", "atan", "atan2", "acos", "asin")}
    for node in statements(tree):
        if isinstance(node, ast.Attribute) and dotted(node) in elementary:
            yield dotted(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            words = {word.arg for word in node.keywords}
            name = node.func.attr
            ties = name in ("argsort", "argpartition") or (name == "sort" and "order" in words)
            if ties and not words & {"kind", "stable"}:
                yield name


def python_files(root: Path, *places: str, having: str = "") -> Iterator[tuple[str, ast.AST]]:
    """Return names and trees of the files at some places in whose text a pattern is."""
    for place in places:
        for path in sorted((root / place).rglob("*.py")) or [root / place]:
            text = path.read_text(encoding="utf-8")
            if re.search(having, text):
                yield path.relative_to(root).as_posix(), ast.parse(text)


def test_data_of_tests_call_nothing_that_depends_on_the_processor(root: Path) -> None:
    makers = list(python_files(root, *MAKERS))
    used = {(name, what) for name, tree in makers for node in statements(tree) for what in refused_here(node)}
    assert used == ALLOWED_MAKERS
    files = [*makers, *python_files(root, "tests", having=SUSPECT)]
    assert {(name, what) for name, tree in files if name != TWIN for what in refused_data(tree)} == set()


def test_check_of_test_data_finds_calls_that_depend_on_the_processor() -> None:
    tree = ast.parse(
        "a = np.exp(b)\nc = np.argsort(a)\nd = np.sort(a, order='x')\ne = math.sin(1)\nassert np.log(a) > 1"
    )
    assert sorted(refused_data(tree)) == ["argsort", "math.sin", "np.exp", "sort"]
    assert list(refused_data(ast.parse("a = np.argsort(b, kind='stable')\nassert_allclose(a, np.exp(b))"))) == []


def test_check_of_results_finds_calls_that_depend_on_the_processor() -> None:
    tree = ast.parse("a = b @ c\nd = np.linalg.inv(a) + np.exp(a)\ncv2.resize(a, interpolation=cv2.INTER_CUBIC)")
    assert set(refused_names(tree)) == {"@", "np.linalg.inv", "np.exp", "cv2.INTER_CUBIC"}
