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
"""On a GPU too, indices of its tensors may lie on the CPU; those of the CPU's tensors may not lie on the GPU."""
ANSWERS = {aten._local_scalar_dense.default, aten.equal.default}
"""Give Python a number or a truth: ``item``, ``bool``, ``equal``."""
COUNTS = {aten.nonzero.default, aten.masked_select.default, aten._unique2.default, aten.repeat_interleave.Tensor}
"""The CPU has to know how large their results are."""


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
    checked = args[:1] + args[2:] if operation in INDEXING and isinstance(args[0], Elsewhere) else args
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


def returns(operation: Any, args: Any, found: Any) -> tuple[int, ...] | None:
    """Shape of what the operation brings back to the CPU, () for a number; None if it leaves the device alone."""
    if not any(isinstance(value, Elsewhere) for value in tree_leaves(args)):
        return None
    if operation in MOVES and not isinstance(found, Elsewhere):
        return tuple(found.shape)
    picks = operation in INDEXING and any(index is not None and index.dtype == torch.bool for index in args[1])
    return () if picks or operation in ANSWERS | COUNTS else None


class _SecondDevice(TorchDispatchMode):
    """Makes ``device="meta"`` mean the second device, and notes what comes back from it."""

    def __init__(self) -> None:
        super().__init__()
        self.returned: list[tuple[int, ...]] = []

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = compute(operation, args, kwargs or {})
        shape = returns(operation, args, found)
        if shape is not None:
            self.returned.append(shape)
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
    """Inside, ``meta`` is the second device; gives the shapes of all that has come back to the CPU so far.

    A number that Python asked for, or the size of a result that depends on values, has the shape ().
    """
    with _FromNumbers(), _SecondDevice() as mode:
        yield mode.returned
