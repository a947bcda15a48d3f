"""One process per folder: a lock that ends with its process, however that ends."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

LOCK_FILE = ".lock"


@contextmanager
def only_one(folder: Path, refusal: str, name: str = LOCK_FILE) -> Iterator[None]:
    """Hold the existing ``folder`` for this process, through its lock file ``name``.

    Raises:
        ValueError: another process holds it; says ``refusal``.
    """
    lock = FileLock(folder / name)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise ValueError(refusal) from error
    try:
        yield
    finally:
        lock.release()
