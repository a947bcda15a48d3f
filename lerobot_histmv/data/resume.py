"""The order of rows of a resumed training: LeRobot's sampler, made to go on where the checkpoint was written.

LeRobot restores its sampler before accelerate prepares the loader, and the prepared loader then numbers its epochs from
0 again, so every epoch but the first would go on with the rows of the first. It also fills the last batches of an epoch
from the rows that it read first, which after a restart are not the epoch's first ones.
"""

from collections.abc import Iterator
from itertools import chain, islice
from typing import Any

from lerobot.datasets import EpisodeAwareSampler


class ResumedSampler(EpisodeAwareSampler):
    """Rows in the order of a training that was never stopped.

    Args:
        batch_size: rows per process and step.
        processes: how many learn together.
    """

    def __init__(self, *args: Any, batch_size: int, processes: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        missing = -len(self) % (batch_size * processes)
        self._filling = missing if processes > 1 else 0
        self._loaded: int | None = None
        self._ahead = 0

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on from an epoch and an index into its order of rows."""
        super().load_state_dict(state)
        self._loaded = state["epoch"]

    def set_epoch(self, epoch: int) -> None:
        """What the loader calls each epoch; the first number it gives after loading means the epoch that was loaded."""
        if self._loaded is not None:
            self._ahead, self._loaded = self._loaded - epoch, None
        super().set_epoch(epoch + self._ahead)

    def __iter__(self) -> Iterator[int]:
        """The rest of the loaded epoch and, on several processes, what fills up its last step; then whole epochs."""
        epoch, start = self._epoch, self._start_index
        rest = super().__iter__()
        return chain(rest, islice(self._iter_epoch(epoch, 0), self._filling)) if start else rest
