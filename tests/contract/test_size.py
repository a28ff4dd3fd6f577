"""The package keeps to a number of nodes of its syntax trees; docs/internals/architecture.md says why."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "gsmerge"
MOST_NODES = 465_000


def is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def count_nodes(text: str) -> int:
    """Count the nodes of a module's syntax tree; a docstring counts nothing, an empty body one node."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [child for child in body if not is_docstring(child)] or [ast.Pass()]  # type: ignore[attr-defined]
    return sum(1 for _ in ast.walk(tree))


def test_the_package_does_not_grow() -> None:
    """What a change takes out is taken from the number as well, so that it is not spent again."""
    count = sum(count_nodes(path.read_text("utf-8")) for path in PACKAGE.rglob("*.py"))
    assert count <= MOST_NODES, "take something out, or raise the number in the commit, which says why"
    assert count > 0.99 * MOST_NODES, "lower the number to the next hundred above the count"


def test_words_lines_and_packing_count_nothing() -> None:
    plain = "def f():\n    a = 1\n    b = 2\n"
    told = 'def f():\n    """Say it."""\n    # twice\n    a = 1\n\n    b = (\n        2\n    )\n'
    assert count_nodes(told) == count_nodes(plain)
    assert count_nodes("def f():\n    a, b = 1, 2\n") > count_nodes(plain)
