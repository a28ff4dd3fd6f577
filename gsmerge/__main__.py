"""``python -m gsmerge``."""

from gsmerge.cli import program

program()
