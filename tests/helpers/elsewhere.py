"""A second device without hardware: tensors that say they lie on ``meta``, computed on the CPU.

As on a GPU, an operation that mixes them with CPU tensors fails, and what returns to the CPU is seen. Unlike torch's
own meta tensors they have values, so that code whose shapes depend on values runs to its end.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")
aten = torch.ops.aten
MOVES = {aten._to_copy.default, aten.copy_.default}
INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default}
"""On a GPU too, indices may lie on the CPU."""


class Elsewhere(Tensor):
    """A tensor on the second device."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "Elsewhere":
        made: Elsewhere = Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=DEVICE,
        )
        made.values = values
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(operation, args, kwargs or {})

    def tolist(self) -> list[Any]:
        """Torch refuses this for every subclass; on a GPU it moves the values to the CPU first."""
        return self.cpu().tolist()

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Elsewhere({self.values})"


def compute(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The operation as the second device does it.

    Raises:
        RuntimeError: its tensors lie on both devices.
    """
    checked = args[:1] + args[2:] if operation in INDEXING else args
    tensors = [value for value in tree_leaves((checked, kwargs)) if isinstance(value, Tensor)]
    away = [tensor for tensor in tensors if isinstance(tensor, Elsewhere)]
    here = [tensor for tensor in tensors if not isinstance(tensor, Elsewhere) and tensor.ndim]
    if away and here and operation not in MOVES:
        raise RuntimeError(f"{operation} of tensors on two devices: {[tuple(tensor.shape) for tensor in here]} on cpu")
    device = kwargs.get("device")
    wanted = device.type == DEVICE.type if isinstance(device, torch.device) else bool(away)
    if operation is aten.copy_.default:
        wanted = isinstance(args[0], Elsewhere)
    if isinstance(device, torch.device):
        kwargs = kwargs | {"device": torch.device("cpu")}
    known = {id(tensor.values): tensor for tensor in away}
    args, kwargs = tree_map(lambda value: value.values if isinstance(value, Elsewhere) else value, (args, kwargs))
    found = operation(*args, **kwargs)

    def wrap(value: Any) -> Any:
        if not wanted or not isinstance(value, Tensor):
            return value
        return known[id(value)] if id(value) in known else Elsewhere(value)

    return tree_map(wrap, found)


class _SecondDevice(TorchDispatchMode):
    """Makes ``device="meta"`` mean the second device, and notes what is moved back from it."""

    def __init__(self) -> None:
        super().__init__()
        self.returned: list[tuple[int, ...]] = []

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = compute(operation, args, kwargs or {})
        moved = operation in MOVES and any(isinstance(value, Elsewhere) for value in args)
        if moved and not isinstance(found, Elsewhere):
            self.returned.append(tuple(found.shape))
        return found


class _FromNumbers(TorchFunctionMode):
    """Tensors made of Python's numbers, which torch would make on its own meta device, without values."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if function is torch.tensor and torch.device(kwargs.get("device") or "cpu") == DEVICE:
            return torch.tensor(*args, **kwargs | {"device": "cpu"}).to(DEVICE)
        if function is Tensor.new_tensor and isinstance(args[0], Elsewhere):
            return torch.tensor(args[1], **{"dtype": args[0].dtype} | kwargs).to(DEVICE)
        return function(*args, **kwargs)


@contextmanager
def second_device() -> Iterator[list[tuple[int, ...]]]:
    """Inside, ``meta`` is the second device; gives the shapes of all tensors moved back to the CPU so far."""
    with _FromNumbers(), _SecondDevice() as mode:
        yield mode.returned
