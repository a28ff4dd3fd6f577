"""The declarations of the native library's functions are those of its sources."""

import importlib
import pkgutil
import re

import gsmerge.method.kernels
from gsmerge.method.kernels.build import FOLDER
from gsmerge.method.kernels.raster.step import STEP
from gsmerge.method.kernels.signature import PROTOTYPES


def prototypes():
    """Return the declarations in C, by name, of everything that calls the library."""
    for module in pkgutil.walk_packages(gsmerge.method.kernels.__path__, "gsmerge.method.kernels."):
        if "-" not in module.name:  # a built library
            importlib.import_module(module.name)
    return PROTOTYPES


def sources():
    text = "".join(path.read_text() for path in sorted(FOLDER.rglob("*.c")))
    return re.sub(r"\s+", " ", re.sub(r"\brestrict ", "", text))


def test_declarations_match_the_functions_of_the_c_sources():
    text = sources()
    missing = {name: prototype for name, prototype in prototypes().items() if f"API {prototype} {{" not in text}
    assert not missing


def test_every_function_of_the_library_is_declared():
    names = set(re.findall(r"API [\w ]+?\*? ?(\w+)\(", sources()))
    assert names - {"processor_level"} == set(prototypes())


def test_the_table_of_a_step_is_the_struct_of_its_source():
    """The same fields in the same order, addresses first."""
    text = (FOLDER / "raster" / "step.c").read_text()
    (body,) = re.findall(r"typedef struct \{\n([^}]*)\} Step;", text)
    fields = [(kind, name) for kind, names in re.findall(r"(\w+) ([^;]*);", body) for name in re.split(r",\s*", names)]
    assert [name.lstrip("*") for _, name in fields] == list(STEP.fields)
    for (kind, name), argument in zip(fields, STEP.arrays.values(), strict=False):
        assert f"{kind} *" == argument.c.removeprefix("const "), name
    assert all(kind == "int64_t" and name[0] != "*" for kind, name in fields[len(STEP.arrays) :])
