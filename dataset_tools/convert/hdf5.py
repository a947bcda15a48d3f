"""Reading an HDF5 file that is not trusted: nothing outside of the file is opened, and only plain numbers are read."""

import json
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import h5py

LARGEST_BYTES = 4 * 1024**3
"""A dataset of one episode that claims to be larger is refused before memory is taken for it."""


Shape = tuple[int | EllipsisType, ...]


def open_file(path: Path) -> "h5py.File":
    """The file, for reading.

    Raises:
        ValueError: h5py is missing, or the file is none of HDF5.
    """
    try:
        import h5py
    except ImportError as error:
        raise ValueError('HDF5 files need h5py: pip install "lerobot_policy_histmv[hdf5]"') from error
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} is no HDF5 file that can be read: {error}") from error


def names(parent: "h5py.Group") -> list[str]:
    """Names in a group, looked up without following links."""
    return list(parent)


def group(parent: "h5py.Group", name: str) -> "h5py.Group":
    """The group called ``name``; ValueError if there is none."""
    import h5py

    found = _child(parent, name)
    if not isinstance(found, h5py.Group):
        raise ValueError(f"{_place(parent, name)} is no group")
    return found


def dataset(parent: "h5py.Group", name: str, shape: Shape, kinds: str) -> "h5py.Dataset":
    """A dataset, not yet read.

    Args:
        parent: the group that holds it.
        name: its name there.
        shape: what it must be; -1 stands for any length, a leading ``...`` for any number of dimensions.
        kinds: accepted kinds of numbers: f real, u unsigned, i signed, b bool.

    Raises:
        ValueError: there is none, it refers to another file, holds no plain numbers, has another shape or is too large.
    """
    import h5py

    found, place = _child(parent, name), _place(parent, name)
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"{place} is no dataset")
    if found.is_virtual or found.external:
        raise ValueError(f"{place} lies in another file; only what is in this file is read")
    tail = shape[1:] if shape[0] is ... else shape
    have = found.shape[-len(tail) :] if shape[0] is ... else found.shape
    fits = len(have) == len(tail) and all(w in (-1, h) for w, h in zip(tail, have, strict=True))
    if found.dtype.kind not in kinds or not fits:
        raise ValueError(f"{place} is {found.dtype} of shape {found.shape}; expected is shape {shape}, kind {kinds}")
    if found.nbytes > LARGEST_BYTES:
        raise ValueError(f"{place} claims {found.nbytes} bytes; at most {LARGEST_BYTES} are read")
    return found


def numbers(parent: "h5py.Group", name: str, shape: Shape) -> np.ndarray:
    """The contents of a dataset of numbers as float64; ValueError if one is not finite, or as ``dataset``."""
    values = np.asarray(dataset(parent, name, shape, "fiu")[()], dtype=np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{_place(parent, name)} holds values that are not finite")
    return values


def attribute(holder: "h5py.Group", name: str) -> Any:
    """What the JSON text in an attribute says; None if there is no such attribute.

    Raises:
        ValueError: it is no JSON text.
    """
    if name not in holder.attrs:
        return None
    text = holder.attrs[name]
    try:
        return json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{_place(holder, '@' + name)} is no JSON text: {error}") from error


def _child(parent: "h5py.Group", name: str) -> Any:
    import h5py

    if name not in names(parent):
        raise ValueError(f"{_place(parent, name)} does not exist; there are {', '.join(parent) or 'no entries'}")
    # Asked of the file itself: h5py's own look-ups follow a link to see whether it leads anywhere.
    if parent.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError(f"{_place(parent, name)} is a link; links are not followed, since they may leave the file")
    return parent[name]


def _place(parent: "h5py.Group", name: str) -> str:
    return f"{Path(parent.file.filename).name}:{parent.name.rstrip('/')}/{name}"
