"""Decoded columns on disk, shared by all processes: found by fingerprint, written once, bounded in size."""

import contextlib
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import datasets
from filelock import FileLock

from lerobot_histmv.data.columns import Chunk, Columns, write
from lerobot_histmv.user_cache import cache_folder

logger = logging.getLogger(__name__)

FORMAT = "1"
"""Part of every fingerprint: change it with what the files hold."""
DEFAULT_LIMIT_GB = 20.0
MISSING_OR_DAMAGED = (OSError, ValueError, EOFError)


def size_limit() -> float:
    """Bytes that all cached datasets together may take: ``$HISTMV_CACHE_GB`` (default 20) gigabytes.

    Raises:
        ValueError: the variable is no number, or negative.
    """
    text = os.environ.get("HISTMV_CACHE_GB", str(DEFAULT_LIMIT_GB))
    try:
        gigabytes = float(text)
    except ValueError:
        gigabytes = -1.0
    if not gigabytes >= 0:
        raise ValueError(f"HISTMV_CACHE_GB={text!r}: it must be a number of gigabytes >= 0")
    return gigabytes * 1e9


def cache_name(root: Path, table: datasets.Dataset, episodes: Sequence[int] | None, keys: Sequence[str]) -> str:
    """Name of the cache of ``keys``: which selection of which dataset, then a fingerprint of its present content.

    The content is told by size and time of every data file, by ``meta/info.json`` and by the files that ``table`` was
    loaded from, so that a table loaded before a change of the dataset is never stored under the changed one's name.
    """
    files = sorted((root / "data").glob("*/*.parquet"))
    stats = [(str(path.relative_to(root)), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    loaded = sorted(file["filename"] for file in table.cache_files)
    content = [FORMAT, stats, (root / "meta/info.json").read_text(), loaded, list(keys)]
    source = [str(root.resolve()), None if episodes is None else list(episodes)]
    return f"{_digest(source)}-{_digest(content)}"


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]


def open_or_build(name: str, keys: Sequence[str], rows: int, build: Callable[[], Iterator[Chunk]]) -> Columns:
    """The columns cached as ``name``, built first if they are missing or damaged.

    Processes that ask at the same time wait for the one that builds. A finished cache appears by one rename, so a
    killed build leaves nothing that could be taken for it. Where the disk cannot be written, the columns are gathered
    in memory, with a warning.
    """
    folder = cache_folder() / "frames" / name
    with contextlib.suppress(*MISSING_OR_DAMAGED):
        return _open(folder, keys, rows)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.parent / ".lock"):
            with contextlib.suppress(*MISSING_OR_DAMAGED):
                return _open(folder, keys, rows)
            _build(folder, rows, build)
            return _open(folder, keys, rows)
    except OSError as error:
        logger.warning("no frame cache in %s (%s): frames are kept in the memory of each process", folder.parent, error)
        return Columns.in_memory(build())


def _build(folder: Path, rows: int, build: Callable[[], Iterator[Chunk]]) -> None:
    partial = folder.with_suffix(".partial")
    for leftover in (partial, folder):
        shutil.rmtree(leftover, ignore_errors=True)
    partial.mkdir()
    try:
        write(build(), partial, rows)
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    _trim(folder)


def _open(folder: Path, keys: Sequence[str], rows: int) -> Columns:
    columns = Columns.mapped(folder, keys, rows)
    with contextlib.suppress(OSError):
        os.utime(folder)
    return columns


def _trim(keep: Path) -> None:
    """Remove what ``keep`` replaces and what killed builds left, then the caches unused for longest, to ``size_limit``.

    Processes that have a removed cache mapped keep it until they end.
    """
    used = _size(keep)
    others = [path for path in keep.parent.iterdir() if path.is_dir() and path != keep]
    for path in sorted(others, key=lambda path: path.stat().st_mtime, reverse=True):
        used += _size(path)
        replaced = path.name.partition("-")[0] == keep.name.partition("-")[0]
        if replaced or path.suffix == ".partial" or used > size_limit():
            used -= _size(path)
            shutil.rmtree(path, ignore_errors=True)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())
