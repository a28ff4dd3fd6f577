"""Exporters that are known by name: one module per family. Adding one is an Exporter and a line in the registry."""

from gsmerge.io.exporters.exporter import Exporter
from gsmerge.io.exporters.registry import EXPORTERS, exporter_names, find_exporter, recognise

__all__ = ["EXPORTERS", "Exporter", "exporter_names", "find_exporter", "recognise"]
