"""Settings of a batch."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from string import Formatter
from typing import Any

from gsmerge.io import OUTPUT_FORMATS, output_format
from gsmerge.io.formats.read import OpacityChoice
from gsmerge.options import CHECKPOINTS, CompactOptions
from gsmerge.runtime.work import Engine
from gsmerge.scene.content_hash import digest
from gsmerge.scene.exporters import AUTO, ReadHints

FIELDS = ("stem", "parent", "index", "k")


@dataclass(frozen=True)
class BatchOptions:
    """Settings of :func:`gsmerge.batch.run_batch`; ValueError if one is out of range."""

    settings: CompactOptions = field(default_factory=CompactOptions)  # of a scene; no threads: processors by jobs
    opacity: OpacityChoice = "auto"  # how all files store opacity
    hints: ReadHints = AUTO  # what is known of all files and need not be recognised
    # Cameras, and folder of photos, of a scene: one path for all, or with ``{scene}``, ``{parent}`` and ``{stem}`` in
    # it; None: next to each scene.
    cameras: str | None = None
    images: str | None = None
    # Name of a result in the output folder, made of ``{stem}`` (the scene's name), ``{parent}`` (name of the folder it
    # is in), ``{index}`` (its place in the list, from 0) and ``{k}``; its ending says the format.
    output: str = "{stem}.ply"
    jobs: int | None = None  # scenes at once; None: as many as processors and memory allow
    max_memory: int | None = None  # bytes that they may take together; None: what is free, on the nodes of Ray always
    timeout: float | None = None  # seconds that a scene may take; None: any
    retries: int = 1  # how often a scene is tried again if its process died or took too long
    rerun: bool = False  # compact scenes again that are done
    overwrite: bool = False  # replace files in the output folder that no batch wrote
    engine: str = "local"  # "local": processes on this machine; "ray": a Ray cluster
    address: str | None = None  # of the Ray cluster; None: one of this machine alone, started for the run

    def __post_init__(self) -> None:
        try:
            names = [name for _, name, _, _ in Formatter().parse(self.output) if name is not None]
            example = self.output.format(**dict.fromkeys(FIELDS, 1))
        except (ValueError, LookupError, AttributeError, TypeError):
            names, example = [""], ""
        known, endings = ", ".join(f"{{{name}}}" for name in FIELDS), OUTPUT_FORMATS
        is_outside = example.startswith(("/", "~", ".")) or ".." in example.split("/")
        for is_possible, expected in (
            (all(name in FIELDS for name in names), f"{known} in braces"),
            (example.lower().endswith(endings), f"a name that ends in {', '.join(endings)}"),
            (
                not is_outside and "\\" not in example and "\0" not in example,
                "a name inside the output folder, not hidden",
            ),
        ):
            if not is_possible:
                raise ValueError(f"output: expected {expected}, got {self.output!r}")
        budget = self.settings.budget
        if budget.in_bytes and output_format(self.output).ending != ".ply":
            raise ValueError(f"budget {budget.budget}: expected an output as .ply, got {self.output}; give a number")
        is_ray = Engine(self.engine, self.address).name == "ray"
        memory = self.max_memory
        for is_possible, problem in (
            (self.jobs is None or self.jobs >= 1, f"jobs: expected at least 1, got {self.jobs}"),
            (memory is None or memory >= 1, f"max memory: expected at least 1 byte, got {memory}"),
            (self.timeout is None or self.timeout > 0, f"timeout: expected more than 0 s, got {self.timeout}"),
            (self.retries >= 0, f"retries: expected at least 0, got {self.retries}"),
            (memory is None or not is_ray, "max memory: expected engine local; Ray knows the memory of its nodes"),
        ):
            if not is_possible:
                raise ValueError(problem)

    def result_settings(self) -> dict[str, Any]:
        """Return everything that a result depends on besides the scene's files, as plain values."""
        settings = self.settings.to_dict()
        del settings["threads"]
        return {"settings": settings, "opacity": self.opacity, "reading": vars(self.hints)}

    def name(self) -> str:
        """Return a digest that is equal for runs that make the same results."""
        return digest({**self.result_settings(), "output": self.output, "cameras": self.cameras, "images": self.images})


def with_whole_paths(options: BatchOptions) -> BatchOptions:
    """Return the options with absolute paths, which mean the same on every node."""
    settings = options.settings
    if settings.checkpoint not in CHECKPOINTS:
        settings = replace(settings, checkpoint=os.path.abspath(settings.checkpoint))
    cameras, images = (
        path if path is None or path.startswith("{") else os.path.abspath(path)
        for path in (options.cameras, options.images)
    )
    return replace(options, settings=settings, cameras=cameras, images=images)
