"""Lists modules of fewer than 60 lines that exactly one other module imports: a report, not a limit.

python tools/small_modules.py

Such a file is worth a look: it may read better inside its importer. It may also be a choice, as the readers of one
format each are.
"""

from __future__ import annotations

from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
FEW_LINES = 60  # below this, a file of its own needs a reason


def main() -> None:
    """Print lines, module and its importer, smallest first."""
    rows = small_modules()
    for lines, module, importer in rows:
        print(f"{lines:4}  {module}  <- {importer}")
    print(f"{len(rows)} modules below {FEW_LINES} lines with one importer")


def small_modules() -> list[tuple[int, str, str]]:
    """Lines, name and importer of each; packages themselves are left out."""
    graph = grimp.build_graph("gsmerge", cache_dir=None)
    rows = []
    for module in graph.modules:
        path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        importers = graph.find_modules_that_directly_import(module)
        if path.is_file() and len(importers) == 1:
            lines = len(path.read_text(encoding="utf-8").splitlines())
            rows += [(lines, module, *importers)] if lines < FEW_LINES else []
    return sorted(rows)


if __name__ == "__main__":
    main()
