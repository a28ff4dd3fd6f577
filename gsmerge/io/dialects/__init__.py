"""Exporters that are known by name: one module per family. Adding one is a Dialect and a line in the registry."""

from gsmerge.io.dialects.dialect import Dialect
from gsmerge.io.dialects.registry import DIALECTS, dialect_words, find_dialect, recognise

__all__ = ["DIALECTS", "Dialect", "dialect_words", "find_dialect", "recognise"]
