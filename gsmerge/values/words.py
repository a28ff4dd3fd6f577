"""Words of messages that depend on a number."""

from __future__ import annotations


def count_words(number: int, noun: str, rest: str = "") -> str:
    """Return a number with its noun, in the plural unless the number is 1, and the ``rest`` of the phrase.

    Example:
        >>> count_words(1, "row"), count_words(1200, "row", "set aside")
        ('1 row', '1,200 rows set aside')
    """
    return f"{number:,} {noun}{'' if number == 1 else 'es' if noun.endswith('ch') else 's'}" + (
        f" {rest}" if rest else ""
    )
