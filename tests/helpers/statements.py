"""Count the statements of each room: python tests/helpers/statements.py prints the numbers for docs/internals/size.md.

Statements are those of the syntax tree without docstrings, so neither lines nor words play a part.
"""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("gsmerge", "tests", "benchmarks", "tools", "examples", "docs")
NUMBERS = "numbers at module level"


def count_statements(tree: ast.Module) -> int:
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    return sum(not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)) for node in statements)


def count_numbers(tree: ast.Module) -> int:
    """Count the numbers that names of a module stand for, alone or in a tuple."""
    values = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)]
    parts = [part for value in values for part in (value.elts if isinstance(value, ast.Tuple) else [value])]
    parts = [part.operand if isinstance(part, ast.UnaryOp) else part for part in parts]
    return sum(isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in parts)


def room_of(path: Path) -> str:
    """Return the folder of the package that a file lies in, or the folder of the project."""
    if path.parts[0] == "gsmerge":
        return f"gsmerge/{path.parts[1]}" if len(path.parts) > 2 else "gsmerge"
    return path.parts[0] if len(path.parts) > 1 else "."


def count_rooms() -> dict[str, int]:
    """Count the statements of every room, and the numbers at module level in the package."""
    counts: Counter[str] = Counter()
    paths = [*ROOT.glob("*.py"), *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))]
    for path in paths:
        tree, room = ast.parse(path.read_text("utf-8")), room_of(path.relative_to(ROOT))
        counts[room] += count_statements(tree)
        if room.startswith("gsmerge"):
            counts[NUMBERS] += count_numbers(tree)
    return dict(counts)


if __name__ == "__main__":
    for name, count in sorted(count_rooms().items()):
        print(f"| {name} | {count:,} |")
