"""The declarations of the native library's functions are those of its sources."""

import importlib
import pkgutil
import re

import gsmerge.kernels
from gsmerge.kernels.build import FOLDER


def functions():
    """Yield name and declaration of everything that calls the library."""
    modules = [gsmerge.kernels, *(importlib.import_module(m.name) for m in walk())]
    for module in modules:
        for value in vars(module).values():
            prototype = getattr(value, "prototype", None)
            if prototype is not None:
                yield value.__name__.lstrip("_"), prototype


def walk():
    modules = pkgutil.walk_packages(gsmerge.kernels.__path__, "gsmerge.kernels.")
    return (module for module in modules if "kernels-" not in module.name)  # the libraries lie beside them


def sources():
    text = "".join(path.read_text() for path in sorted(FOLDER.rglob("*.c")))
    return re.sub(r"\s+", " ", re.sub(r"\brestrict ", "", text))


def test_declarations_are_those_of_the_sources():
    text = sources()
    missing = {name: prototype for name, prototype in functions() if f"API {prototype} {{" not in text}
    assert not missing


def test_every_function_of_the_library_is_declared():
    names = set(re.findall(r"API [\w ]+?\*? ?(\w+)\(", sources()))
    assert names - {"processor_level"} == {name for name, _ in functions()}
