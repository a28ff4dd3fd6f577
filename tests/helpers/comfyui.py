"""These modules stand in for what the nodes of ``examples/comfyui`` use of ComfyUI 0.27."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar


class CancelError(Exception):
    """ComfyUI's InterruptProcessingException."""


class Splat:
    """ComfyUI's ``Types.SPLAT``: a batch, padded to a common length."""

    def __init__(
        self, positions: Any, scales: Any, rotations: Any, opacities: Any, sh: Any, counts: Any = None
    ) -> None:
        self.positions, self.scales, self.rotations = positions, scales, rotations
        self.opacities, self.sh, self.counts = opacities, sh, counts


class Kind:
    """One type of inputs and outputs."""

    @staticmethod
    def Input(  # noqa: N802
        id: str, display_name: str | None = None, optional: bool = False, tooltip: str | None = None, **widget: Any
    ) -> dict[str, Any]:
        return {"id": id, "optional": optional, **widget}

    @staticmethod
    def Output(  # noqa: N802
        id: str | None = None, display_name: str | None = None, tooltip: str | None = None, is_output_list: bool = False
    ) -> dict[str, Any]:
        return {"id": id, "is_output_list": is_output_list}


def schema(
    *, node_id: str, display_name: str, category: str, description: str, inputs: list[Any], outputs: list[Any],
    search_aliases: tuple[str, ...] | list[str] = (), is_input_list: bool = False, is_output_node: bool = False,
) -> SimpleNamespace:  # fmt: skip
    """Return ComfyUI's ``IO.Schema``, with the arguments that the nodes use."""
    return SimpleNamespace(**locals())


class Bar:
    """ComfyUI's ``ProgressBar``; ``seen`` has what was set, of all bars."""

    seen: ClassVar[list[int]] = []
    cancelled: ClassVar[list[bool]] = []

    def __init__(self, total: int) -> None:
        self.total = total

    def update_absolute(self, value: int) -> None:
        assert 0 <= value <= self.total
        self.seen.append(value)


def modules(folder: Path) -> dict[str, ModuleType]:
    """Return the modules by name. Files go below ``folder``; a run ends once ``Bar.cancelled`` is not empty."""

    def module(name: str, **content: Any) -> ModuleType:
        new = ModuleType(name)
        vars(new).update(content)
        return new

    def check() -> None:
        if Bar.cancelled:
            raise CancelError

    def save_path(prefix: str, outputs: str) -> tuple[str, str, int, str, str]:
        path = Path(outputs, prefix)
        path.parent.mkdir(parents=True, exist_ok=True)
        return str(path.parent), path.name, len(list(path.parent.iterdir())) + 1, "", prefix

    kinds = ("Splat", "Image", "String", "Combo", "Load3DCamera", "File3DAny")
    io = SimpleNamespace(
        **dict.fromkeys(kinds, Kind), ComfyNode=object, Schema=schema,
        NodeOutput=lambda *args: SimpleNamespace(args=args),
    )  # fmt: skip
    types = SimpleNamespace(SPLAT=Splat, File3D=lambda source: SimpleNamespace(source=source))
    management = module("comfy.model_management", throw_exception_if_processing_interrupted=check)
    tools = module("comfy.utils", ProgressBar=Bar)
    return {
        "comfy": module("comfy", model_management=management, utils=tools),
        "comfy.model_management": management,
        "comfy.utils": tools,
        "folder_paths": module(
            "folder_paths",
            get_input_directory=lambda: str(folder / "input"),
            get_output_directory=lambda: str(folder / "output"),
            get_save_image_path=save_path,
        ),
        "comfy_api": module("comfy_api"),
        "comfy_api.latest": module("comfy_api.latest", IO=io, Types=types, ComfyExtension=object),
    }
