"""Settings of a batch."""

from __future__ import annotations

from dataclasses import dataclass, field
from string import Formatter
from typing import Any

from gsmerge.io import AUTO, OUTPUT_FORMATS, ReadHints, output_format
from gsmerge.io.content_hash import digest
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.options import CompactOptions, to_schema

FIELDS = ("stem", "parent", "index", "k")
ENGINES = ("local", "ray")


@dataclass(frozen=True)
class BatchOptions:
    """Settings of :func:`gsmerge.batch.run_batch`.

    Args:
        settings: Of every scene. ``threads``: those of one scene; None: processors by jobs.
        opacity: How all files store opacity.
        hints: What is known of all files and need not be recognised.
        cameras: Cameras of a scene: one path for all, or with ``{scene}``, ``{parent}`` and ``{stem}`` in it; None:
            next to each scene.
        images: The same for the folder of photos.
        output: Name of a result in the output folder, made of ``{stem}`` (the scene's name), ``{parent}`` (name of
            the folder it is in), ``{index}`` (its place in the list, from 0) and ``{k}``; its ending says the format.
        jobs: Scenes at once; None: as many as processors and memory allow.
        max_memory: Bytes that they may take together; None: what is free. Ray knows the memory of its nodes.
        timeout: Seconds that a scene may take; None: any.
        retries: How often a scene is tried again if its process died or took too long.
        rerun: Compact scenes again that are done.
        overwrite: Replace files in the output folder that no batch wrote.
        engine: ``"local"``: processes on this machine; ``"ray"``: a Ray cluster.
        address: Of the Ray cluster; None: one of this machine alone, started for the run.

    Raises:
        ValueError: If a setting is out of range.
    """

    settings: CompactOptions = field(default_factory=CompactOptions)
    opacity: OpacityChoice = "auto"
    hints: ReadHints = AUTO
    cameras: str | None = None
    images: str | None = None
    output: str = "{stem}.ply"
    jobs: int | None = None
    max_memory: int | None = None
    timeout: float | None = None
    retries: int = 1
    rerun: bool = False
    overwrite: bool = False
    engine: str = "local"
    address: str | None = None

    def __post_init__(self) -> None:
        check_template(self.output)
        budget = self.settings.budget
        if budget.in_bytes and output_format(self.output) != ".ply":
            raise ValueError(f"budget {budget.budget}: expected an output as .ply, got {self.output}; give a number")
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"jobs: expected at least 1, got {self.jobs}")
        if self.max_memory is not None and self.max_memory < 1:
            raise ValueError(f"max memory: expected at least 1 byte, got {self.max_memory}")
        if self.timeout is not None and not self.timeout > 0:
            raise ValueError(f"timeout: expected more than 0 s, got {self.timeout}")
        if self.retries < 0:
            raise ValueError(f"retries: expected at least 0, got {self.retries}")
        if self.engine not in ENGINES:
            raise ValueError(f"engine: expected one of {', '.join(ENGINES)}, got {self.engine!r}")
        if self.address is not None and self.engine != "ray":
            raise ValueError(f"address: expected engine ray, got {self.engine}")
        if self.max_memory is not None and self.engine == "ray":
            raise ValueError("max memory: expected engine local; Ray knows the memory of its nodes")

    def result_settings(self) -> dict[str, Any]:
        """Everything that a result depends on besides the scene's files, as plain values."""
        settings = to_schema(self.settings.to_dict())
        del settings["threads"]
        return {"settings": settings, "opacity": self.opacity, "reading": vars(self.hints)}

    def name(self) -> str:
        """The same for all runs that may share an output folder, as they make the same results of the same scenes."""
        return digest({**self.result_settings(), "output": self.output, "cameras": self.cameras, "images": self.images})


def check_template(template: str) -> None:
    """A ValueError if a template gives no valid names for results.

    It may hold the fields in ``FIELDS``, ends as one of the formats that can be written, and stays in the folder.
    """
    try:
        names = [name for _, name, _, _ in Formatter().parse(template) if name is not None]
        example = template.format(**dict.fromkeys(FIELDS, 1))
    except (ValueError, LookupError, AttributeError, TypeError):
        names, example = [""], ""
    if any(name not in FIELDS for name in names):
        known = ", ".join(f"{{{name}}}" for name in FIELDS)
        raise ValueError(f"output: expected {known} in braces, got {template!r}")
    if not example.lower().endswith(tuple(OUTPUT_FORMATS)):
        raise ValueError(f"output: expected a name that ends in {', '.join(OUTPUT_FORMATS)}, got {template!r}")
    if example.startswith(("/", "~", ".")) or ".." in example.split("/") or "\\" in example or "\0" in example:
        raise ValueError(f"output: expected a name inside the output folder, not hidden, got {template!r}")
