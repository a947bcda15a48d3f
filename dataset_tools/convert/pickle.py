"""Reading RLBench's pickles without running anything that is in them.

A pickle names classes and calls them. Here every name that RLBench's files contain stands for an inert class of this
module, which only keeps what it is given, and any other name is refused. Arrays are rebuilt from their bytes by
``numpy.frombuffer``, not by numpy's own unpickling.
"""

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np


class _Sealed(type):
    """Class of the stand-ins: a pickle may make instances of them, but not change them."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise pickle.UnpicklingError(f"the file tries to change {cls.__name__}.{name}")


class Record(metaclass=_Sealed):
    """The attributes of an ``Observation`` or a ``Demo``, without its class."""


class _DType(metaclass=_Sealed):
    def __init__(self, code: object, *_: object) -> None:
        self.code, self.order = code, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1]

    def numpy(self) -> np.dtype[Any]:
        if not re.fullmatch("[biuf][1248]", str(self.code)) or str(self.order) not in "<>|=":
            raise ValueError(f"an array of dtype {self.code!r} is not read; only plain numbers are")
        return np.dtype(f"{self.order}{self.code}")


class _Array(metaclass=_Sealed):
    """``numpy.ndarray``, its ``_reconstruct`` (the contents come by ``__setstate__``)."""

    def __init__(self, *_: object) -> None:
        self.contents: tuple[Any, ...] = (b"", _DType("f8"), (0,), "C")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran, raw = state
        self.contents = raw, dtype, shape, "F" if fortran else "C"


class _Buffer(_Array):
    """``numpy``'s ``_frombuffer``, which newer pickles call with everything."""

    def __init__(self, *contents: object) -> None:
        self.contents = contents


class _Scalar(_Array):
    """``numpy``'s ``scalar``."""

    def __init__(self, dtype: object, raw: object) -> None:
        self.contents = raw, dtype, (), "C"


_CONTAINERS = (set, frozenset, list, tuple, dict)
_ALLOWED: dict[tuple[str, str], type] = {
    ("rlbench.backend.observation", "Observation"): Record,
    ("rlbench.demo", "Demo"): Record,
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _DType,
    **{("builtins", kind.__name__): kind for kind in _CONTAINERS},
}
for _core in ("numpy.core", "numpy._core"):
    _ALLOWED[f"{_core}.multiarray", "_reconstruct"] = _Array
    _ALLOWED[f"{_core}.multiarray", "scalar"] = _Scalar
    _ALLOWED[f"{_core}.numeric", "_frombuffer"] = _Buffer


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type:
        if (module, name) not in _ALLOWED:
            raise ValueError(
                f"it asks for {module}.{name}; only arrays, containers and RLBench's Observation and Demo are read"
            )
        return _ALLOWED[module, name]


def load(path: Path) -> Any:
    """What a pickle of RLBench holds: plain values, containers, ``Record`` and arrays that ``numbers`` reads.

    Raises:
        ValueError: the file is damaged, or names a class that is not RLBench's; nothing of it was run.
    """
    with path.open("rb") as file:
        try:
            return _Unpickler(file).load()
        except Exception as error:  # a damaged pickle raises whatever its bytes lead to
            raise ValueError(f"{path} is refused: {error}") from error


def numbers(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """An array (or numbers, or nested lists of them) of a pickle as float64.

    Args:
        value: what ``load`` gave.
        shape: what it must be; -1 stands for any length.
        what: begins the message.

    Raises:
        ValueError: it is nothing of that, of another shape, or not finite.
    """
    try:
        array = np.asarray(_plain(value), dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{what} cannot be read as numbers: {error}") from error
    fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise ValueError(f"{what} has shape {array.shape} or is not finite; it must be finite numbers of shape {shape}")
    return array


def _plain(value: object) -> Any:
    if isinstance(value, _Array):
        raw, dtype, shape, order = value.contents
        return np.frombuffer(raw, dtype.numpy()).reshape(shape, order=order)
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if not isinstance(value, bool | int | float):
        raise TypeError(f"it is of type {type(value).__name__}")
    return value
