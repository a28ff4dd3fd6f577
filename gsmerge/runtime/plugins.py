"""Import functions of optional parts, and plugins of other packages, only when they are used."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

# groups of the entry points of plugins
COMMANDS = "gsmerge.commands"
METHODS = "gsmerge.methods"


@dataclass(frozen=True)
class LazyFunction:
    """A function whose module is imported at the first call, so that tables of functions import nothing."""

    module: str
    name: str

    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        """Import the module and call the function."""
        return self.load()(*arguments, **settings)

    def load(self) -> Any:
        """Import and return the function."""
        return getattr(import_module(self.module), self.name)


def lazy_functions(package: str) -> Callable[[str], LazyFunction]:
    """Return a function that makes a :class:`LazyFunction` of ``package`` from a text "module.name"."""
    return lambda place: LazyFunction(f"{package}.{place.split('.')[0]}", place.split(".")[1])


@cache
def find_plugins(group: str) -> dict[str, EntryPoint]:
    """Return a group's entry points, sorted by name and not imported; of several with one name, the first."""
    from importlib.metadata import entry_points  # takes 8 ms, and most commands do not need it

    plugins: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        plugins.setdefault(entry.name, entry)
    return plugins


def load_plugin(group: str, name: str) -> Any:
    """Import and return the object of an entry point; if the import fails, raise UsageError with the package's name."""
    entry = find_plugins(group)[name]
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        package = entry.dist.name if entry.dist is not None else entry.module
        raise UsageError(f"{name}: expected {entry.value} of the package {package}, found none ({error})") from error
