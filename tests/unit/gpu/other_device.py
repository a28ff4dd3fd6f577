"""A second device to test on where there is none: its tensors compute on the CPU, and cannot be mixed with the CPU's.

What a GPU refuses is refused here, too: operations on tensors of both, and reading a tensor's memory without
``.cpu()``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")  # what the tensors say they are on: a name that torch knows in every build


class Elsewhere(torch.Tensor):
    """A tensor of the second device; ``inner`` holds its numbers."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Elsewhere:
        made = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=DEVICE, requires_grad=False,
        )  # fmt: skip
        made.inner = inner
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})


def dispatch(func: Any, args: Any, kwargs: Any) -> Any:
    """One operation on the CPU; its result is elsewhere if its tensors are, or if it is asked for there."""
    tensors = [one for one in tree_flatten((args, kwargs))[0] if isinstance(one, torch.Tensor)]
    far = [isinstance(one, Elsewhere) for one in tensors]
    moves = func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
    if any(far) and not moves:
        plain = [one for one, is_far in zip(tensors, far, strict=True) if not is_far and one.ndim > 0]
        assert not plain, f"{func} of tensors on two devices"
    asked = kwargs.get("device")
    result_far = any(far) if asked is None else torch.device(asked) == DEVICE
    inner_kwargs = kwargs if asked is None else {**kwargs, "device": torch.device("cpu")}
    unwrapped = tree_map(lambda one: one.inner if isinstance(one, Elsewhere) else one, (args, inner_kwargs))
    out = func(*unwrapped[0], **unwrapped[1])
    if not result_far:
        return out
    out = tree_map(lambda one: Elsewhere(one) if isinstance(one, torch.Tensor) else one, out)
    return return_and_correct_aliasing(func, args, kwargs, out) if any(far) else out


class Generator(torch.Generator):
    """One for the second device, which is the CPU's."""

    def __new__(cls, device: Any = None) -> Generator:
        return super().__new__(cls)


class SecondDevice(TorchDispatchMode):
    """A block in which ``DEVICE`` is a device with numbers of its own."""

    def __enter__(self) -> SecondDevice:
        self.tensor, self.generator = torch.tensor, torch.Generator  # they ask the device without an operation
        torch.Generator = Generator
        torch.tensor = lambda data, *, dtype=None, device="cpu": self.tensor(data, dtype=dtype).to(device)
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        torch.tensor, torch.Generator = self.tensor, self.generator
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})
