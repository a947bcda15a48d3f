"""Random numbers of one training step: they follow from the rows that the step is made of, not from what ran before."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Int
from torch import Tensor


@contextmanager
def drawn_from(rows: Int[Tensor, " b"] | None) -> Iterator[None]:
    """Inside, torch's random numbers depend on ``rows`` and their order alone; afterwards they go on as if unused.

    LeRobot's order of rows is a function of seed and epoch and its own state survives a restart, but torch's random
    state does not: starting the loader takes a number from it, every rank starts with the same one, and a
    checkpoint holds that of the first rank only. Numbers tied to the rows are the same after a restart, and differ
    between ranks, which have different rows.

    Args:
        rows: numbers of the drawn rows in the dataset; None leaves everything as it is.
    """
    if rows is None:
        yield
        return
    digest = hashlib.blake2b(repr(rows.tolist()).encode(), digest_size=8).digest()
    with torch.random.fork_rng([rows.device] if rows.is_cuda else []):
        torch.manual_seed(int.from_bytes(digest))
        yield
