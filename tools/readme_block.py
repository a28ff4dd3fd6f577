"""Print the block of shell commands in README.md that contains some words, so that it can be run.

bash -euo pipefail -c "$(python3 tools/readme_block.py "tasks.py setup tests")"
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def find_block(words: str, page: Path = README) -> str:
    """Return the one ``bash`` block of a page that contains these words; ValueError if there are none or several."""
    blocks = re.findall(r"^```bash\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    matches = [block for block in blocks if words in block]
    if len(matches) != 1:
        raise ValueError(f"{page.name}: expected one block of bash with {words!r}, found {len(matches)}")
    return matches[0]


if __name__ == "__main__":
    try:
        print(find_block(" ".join(sys.argv[1:])), end="")
    except ValueError as error:
        sys.exit(str(error))
