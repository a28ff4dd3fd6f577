"""Read XML files within a budget of memory: without entities and namespaces, and with only some attributes.

The parser of Python's library may take far more memory than the file has bytes. The parser copies the address of a
namespace into the name of each tag, and needs thirty times the bytes of a tag with a million attributes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_budget, read_text


def read_xml(path: Path, attributes: Collection[str]) -> Element:
    """Read an XML file. Its elements keep only ``attributes``, and names keep the prefixes of their namespaces.

    Raise SceneError if the file is no XML or too large. Also raise SceneError if the file has a document type, since
    entities in a document type could make a short text endless.
    """
    text, builder, parser = read_text(path), TreeBuilder(), expat.ParserCreate()
    budget = read_budget(path)
    element_bytes, attribute_bytes = 200, 330  # most bytes of memory for each "<" and "=" of a file
    budget.check_memory(element_bytes * text.count("<") + attribute_bytes * text.count("="), "XML")

    def start(tag: str, stored: Mapping[str, str]) -> None:
        builder.start(tag, {name: stored[name] for name in attributes if name in stored})

    def refuse(*_: object) -> None:
        raise SceneError(path, "expected XML without a document type, found <!DOCTYPE", "remove that line")

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, refuse
    parser.buffer_text = True
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, AssertionError, LookupError, ValueError) as error:
        raise SceneError(path, f"expected XML, found other text ({error})") from error
