"""Write the page of the Python API, which has every public name by topic, with its signature and docstring."""

from __future__ import annotations

import inspect
import re
import textwrap
from dataclasses import is_dataclass
from typing import Any

import gsmerge
import gsmerge.integrations

TOPICS = {
    "Read": (
        "read_scene",
        "load_scene",
        "read_held_out",
        "read_ply",
        "read_gaussians",
        "read_cameras",
        "to_cameras",
        "inspect",
    ),
    "Compact": ("compact", "compact_tensors", "CompactOptions", "CompactResult", "CompactReport"),
    "Write": ("write_ply", "write_gaussians", "write_levels"),
    "Draw and measure": (
        "view",
        "render",
        "Rendering",
        "evaluate",
        "EvaluateOptions",
        "Evaluation",
        "superpixels",
        "saliency",
    ),
    "Views in batches, results of any size": ("Compactor",),
    "Data": ("Scene", "Gaussians", "Cameras", "Views"),
    "Errors": ("DoubtWarning", "GsmergeError", "SceneError"),
}
ELSEWHERE = {"CompactOptions": "settings.md", "CompactReport": "report.md"}  # pages that describe the fields
HEAD = """# Python API

Every public name of `gsmerge`, from its docstring, which `help()` shows in full. [The guide](../guide/python.md) says
how they work together. Bad files raise `SceneError`, bad arguments `ValueError`. [Settings](settings.md) have a page.
The examples run after `import gsmerge`, beside the scene `demo` of `examples/01_make_scene.py`."""


def api_page() -> str:
    """Return the page in Markdown."""
    listed = [name for names in TOPICS.values() for name in names]
    if sorted(listed) != sorted(set(gsmerge.__all__) - {"__version__"}):
        raise ValueError(f"TOPICS: expected every public name once, got {', '.join(listed)}")
    lines = [HEAD]
    for topic, names in TOPICS.items():
        lines += ["", f"## {topic}"]
        for name in names:
            lines += ["", f"### {name}", "", *_describe(name, getattr(gsmerge, name))]
    lines += ["", "## gsmerge.integrations", "", inspect.cleandoc(gsmerge.integrations.__doc__ or "")]
    for name, value in vars(gsmerge.integrations).items():
        if inspect.isfunction(value) and value.__module__ == gsmerge.integrations.__name__ and name[0] != "_":
            lines += ["", f"### integrations.{name}", "", *_describe(f"integrations.{name}", value)]
    return "\n".join([*lines, ""])


def _describe(name: str, value: Any) -> list[str]:
    """Return the signature, text, arguments and example of a public name as lines of Markdown."""
    text = re.sub(r":\w+:`~?([\w.]+?)`", r"`\1`", inspect.cleandoc(value.__doc__)).replace("``", "`")
    about, *parts = re.split(r"^(Args|Returns|Raises|Example):\n", text, flags=re.MULTILINE)
    lines = [about.strip()]
    if not inspect.isclass(value):
        lines = [f"`gsmerge.{name}{_parameters(value)}`", "", *lines]
    is_data = is_dataclass(value) or (inspect.isclass(value) and issubclass(value, Exception))
    for title, body in zip(parts[::2], parts[1::2], strict=True):
        body = textwrap.dedent(body).strip()
        if title == "Example" and not is_data:
            lines += ["", "```pycon", body, "```"]
        elif title == "Returns":
            lines += ["", f"Returns: {body}"]
        elif title == "Args":
            entries = re.findall(r"^(\*{0,2}\w+): (.*?)(?=^\*{0,2}\w+: |\Z)", body, re.DOTALL | re.MULTILINE)
            listed = [f"- `{entry}`: {' '.join(about.split())}" for entry, about in entries]
            names = ", ".join(f"`{entry}`" for entry, _ in entries)
            lines += ["", *([f"Fields, [described]({ELSEWHERE[name]}): {names}."] if name in ELSEWHERE else listed)]
    return lines


def _parameters(function: Any) -> str:
    """Return a function's parameters with their defaults, but without types."""
    signature = inspect.signature(function)
    untyped = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in signature.parameters.values()]
    text = str(signature.replace(parameters=untyped, return_annotation=inspect.Signature.empty))
    return re.sub(r"<function \S+ at \w+>", "...", text).replace("'", '"')
