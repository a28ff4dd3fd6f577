"""Runs over a grid of settings as jobs of a batch, and figures and a page of their measurements."""

from importlib.util import find_spec

from gsmerge.errors import GsmergeError

INSTALL_HINT = 'pip install "matplotlib>=3.8,<4"'  # as the extra chart asks for


def require_matplotlib() -> None:
    """Raise GsmergeError, with the install command, if matplotlib is missing."""
    if find_spec("matplotlib") is None:
        raise GsmergeError(f"charts need matplotlib, which is not installed: {INSTALL_HINT}")
