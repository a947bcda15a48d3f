"""A folder of results that appears whole or not at all."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def published(root: Path, overwrite: bool, mark: str) -> Iterator[Path]:
    """An empty folder to write to, which becomes ``root`` when the block ends without an error.

    Until then ``root`` keeps what it holds; what an interrupted run left beside it is cleared away or put back.

    Args:
        root: where the results shall be.
        overwrite: whether earlier results there are replaced.
        mark: a file that every such folder has; others are never replaced.

    Raises:
        ValueError: see ``check_free``.
    """
    partial, old = (root.with_name(f".{root.name}.{what}") for what in ("partial", "old"))
    if old.exists() and not root.exists():
        old.rename(root)
    check_free(root, overwrite, mark)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        if root.exists():
            root.rename(old)
        partial.rename(root)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if root.exists():
            shutil.rmtree(old, ignore_errors=True)


def check_free(root: Path, overwrite: bool, mark: str) -> None:
    """ValueError if ``root`` holds something that must not be replaced."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return
    if not (root / mark).is_file():
        raise ValueError(f"{root} exists and holds no {mark}, so it is not replaced; give another --output")
    if not overwrite:
        raise ValueError(f"{root} holds {mark} already; give another --output, or --overwrite=true to replace it")
