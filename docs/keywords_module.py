"""Writes ``gsmerge/settings/keywords.py``: settings as typed keyword arguments, for editors and type checkers."""

from __future__ import annotations

from collections.abc import Iterable
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.setting import Setting, flat_settings
from gsmerge.settings.stages import DecodeOptions

HEAD = '''"""Settings as typed keyword arguments. Made by docs/generate_reference.py from their declarations."""

from __future__ import annotations

from typing import Literal, TypedDict
'''
CLASSES = {
    "CompactKeywords": ("Settings of :func:`gsmerge.compact`.", CompactOptions),
    "DecodeKeywords": ("Settings of :meth:`gsmerge.Compactor.decode`.", DecodeOptions),
    "StateKeywords": ("Settings of :class:`gsmerge.Compactor`.", ExtendOptions),
}
BASES = {"StateKeywords": "CompactKeywords"}


def keywords_module() -> str:
    """Return the text of the module, as the formatter would have it."""
    text = HEAD
    for name, (about, options) in CLASSES.items():
        base = BASES.get(name, "TypedDict")
        text += f'\n\nclass {name}({base}, total=False):\n    """{about}"""\n\n'
        text += "".join(f"    {key}: {_type_of(one)}\n" for key, one in flat_settings(options).items())
    return text


def _type_of(one: Setting) -> str:
    """Return the type of a setting's values; of one with fixed choices these."""
    if one.choices and not callable(one.choices):
        listed = _literal(one.choices)
        return f"{listed} | None" if NoneType in one.kinds else listed
    return _name_type(one.kind)


def _literal(words: Iterable[str]) -> str:
    quoted = ", ".join(f'"{word}"' for word in words)
    return f"Literal[{quoted}]"


def _name_type(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return _literal(get_args(kind))
    if get_args(kind):
        return " | ".join(_name_type(part) for part in get_args(kind))
    return "None" if kind is NoneType else str(kind.__name__)
