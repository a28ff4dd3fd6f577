"""Settings of a batch."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from string import Formatter
from typing import Any

from gsmerge.io import OUTPUT_FORMATS
from gsmerge.scene.content_hash import digest
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.settings.reading import OpacityChoice, ReadHints
from gsmerge.settings.setting import Settings, setting
from gsmerge.settings.stages import Engine

FIELDS = ("stem", "parent", "index", "k")


@dataclass(frozen=True)
class BatchOptions(Settings):
    """Settings of :func:`gsmerge.batch.run_batch`."""

    settings: CompactOptions = setting(CompactOptions(), "Of each scene; no threads, which are processors by jobs.")
    opacity: OpacityChoice = setting("auto", "How all files store opacity.")
    hints: ReadHints = setting(ReadHints(), "What is known of all files and need not be recognised.")
    cameras: str | None = setting(None, "Cameras: one path for all scenes, or with {scene}, {parent} and {stem} of "
        "each in it.",
        "By default those beside each scene.")  # fmt: skip
    images: str | None = setting(None, "Folder of the photos, in the same way.")
    output: str = setting("{stem}.ply", "Name of a result in the output folder: {stem} (the scene's name), {parent} "
        "(the folder it is in), {index} (its place in the list, from 0) and {k} are filled in; its ending says the "
        "format.")  # fmt: skip
    jobs: int | None = setting(None, "Scenes at once.", "By default as many as processors and memory allow.", least=1)
    max_memory: int | None = setting(None, "Memory that all scenes at once may take.",
        "By default what is free, which is also the limit on the nodes of Ray.", least=1, unit="bytes")  # fmt: skip
    timeout: float | None = setting(None, "Seconds that a scene may take.", above=0, unit="seconds")
    retries: int = setting(1, "How often a scene is tried again whose process died or took too long.", least=0)
    rerun: bool = setting(False, "Compact scenes again that are done.")
    overwrite: bool = setting(False, "Replace files in the output folder that no batch wrote.")
    engine: str = setting("local", "Where scenes are compacted, see `Engine`.")
    address: str | None = setting(None, "Address of the Ray cluster, see `Engine`.")

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            names = [name for _, name, _, _ in Formatter().parse(self.output) if name is not None]
            example = self.output.format(**dict.fromkeys(FIELDS, 1))
        except (ValueError, LookupError, AttributeError, TypeError):
            names, example = [""], ""
        placeholders, endings = ", ".join(f"{{{name}}}" for name in FIELDS), OUTPUT_FORMATS
        is_outside = example.startswith(("/", "~", ".")) or ".." in example.split("/")
        for is_possible, expected in (
            (all(name in FIELDS for name in names), f"{placeholders} in braces"),
            (example.lower().endswith(endings), f"a name that ends in {', '.join(endings)}"),
            (
                not is_outside and "\\" not in example and "\0" not in example,
                "a name inside the output folder, not hidden",
            ),
        ):
            if not is_possible:
                raise ValueError(f"output: expected {expected}, got {self.output!r}")
        if Engine(self.engine, self.address).name == "ray" and self.max_memory is not None:
            raise ValueError("max_memory: expected engine local; Ray knows the memory of its nodes")

    def result_settings(self) -> dict[str, Any]:
        """Return all settings that a result depends on, apart from the scene's files, as plain values."""
        settings = self.settings.to_dict()
        del settings["threads"]
        return {"settings": settings, "opacity": self.opacity, "reading": vars(self.hints)}

    def name(self) -> str:
        """Return a digest that is equal for runs whose results are the same."""
        return digest({**self.result_settings(), "output": self.output, "cameras": self.cameras, "images": self.images})


def with_whole_paths(options: BatchOptions) -> BatchOptions:
    """Return the options with absolute paths, which are valid on every node."""
    settings = options.settings
    if settings.checkpoint not in CHECKPOINTS:
        settings = replace(settings, checkpoint=os.path.abspath(settings.checkpoint))
    cameras, images = (
        path if path is None or path.startswith("{") else os.path.abspath(path)
        for path in (options.cameras, options.images)
    )
    return replace(options, settings=settings, cameras=cameras, images=images)
