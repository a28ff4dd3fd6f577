"""What the library would refuse, told as wrong usage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum
from typing import TYPE_CHECKING, Any

from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.io import ReadHints
    from gsmerge.io.alignment.layouts import Order
    from gsmerge.io.hints import QuatChoice
    from gsmerge.options import CompactOptions


def reading_of(
    exporter: str, quats: QuatChoice, order: Order, scene_scale: float | None, max_side: int | None = None
) -> ReadHints:
    """What the command line tells about the file.

    Raises:
        UsageError: If a value is none of the possible ones.
    """
    from gsmerge.io import ReadHints
    from gsmerge.io.exporters import find_exporter

    with told_as_usage():
        find_exporter(exporter)
        found = ReadHints(exporter=exporter, quats=quats, order=order, scene_scale=scene_scale)
        return found if max_side is None else replace(found, max_side=max_side)


@contextmanager
def told_as_usage() -> Iterator[None]:
    """Settings that the library refuses are wrong usage of the command."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def settings_of(chosen: Mapping[str, Any]) -> CompactOptions:
    """The library's options with those that were given."""
    from gsmerge.options import CompactOptions

    given = {name: value.value if isinstance(value, Enum) else value for name, value in chosen.items()}
    with told_as_usage():
        return CompactOptions().with_settings({name: value for name, value in given.items() if value is not None})


def given_settings(params: Mapping[str, Any]) -> CompactOptions:
    """The library's options with those of a command's parameters that carry their names."""
    from gsmerge.options import CompactOptions

    return settings_of({name: params[name] for name in CompactOptions().to_dict() if name in params})
