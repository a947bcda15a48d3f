"""The finished attempts of a recording, one file each: what survives when the recording is killed.

LeRobot's own files have no footer until the whole dataset is finalised, so a kill would lose everything. Here every
attempt is committed by one rename: ``attempt-000007.parquet`` is a successful episode (its columns, and in the schema
metadata what the dataset must know about it), ``attempt-000008.json`` says why an attempt failed.
"""

import dataclasses
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

_HEADER = b"histmv.shard"
_STEM = "attempt-{:06d}"
_TEMPORARY = ".tmp"

Statistics = dict[str, dict[str, np.ndarray]]
"""LeRobot's statistics by column and name."""


@dataclass(frozen=True)
class Outcome:
    """What became of one attempt.

    Args:
        attempt: index of the attempt; its scene seed is the recording's seed plus this.
        task: name of the task that was attempted.
        failure: why it failed; empty for a success.
        rows: frames recorded.
        instruction: the paraphrase drawn for the episode.
        paraphrases: all instructions of the variation, ``instruction`` among them.
        statistics: per image column, LeRobot's statistics as nested lists; of a success only.
    """

    attempt: int
    seed: int
    task: str
    variation: int
    instruction: str
    paraphrases: list[str]
    failure: str
    rows: int
    statistics: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether the episode belongs into the dataset."""
        return not self.failure


def shard_path(directory: Path, attempt: int) -> Path:
    """Where the episode of a successful attempt lies."""
    return directory / f"{_STEM.format(attempt)}.parquet"


def write_success(directory: Path, outcome: Outcome, table: pa.Table) -> None:
    """Commit an episode; the file appears whole or not at all."""
    write_table(shard_path(directory, outcome.attempt), table, dataclasses.asdict(outcome))


def write_table(path: Path, table: pa.Table, header: Mapping[str, Any]) -> None:
    """Write rows and what is to be known about them; the file appears whole or not at all."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}{_TEMPORARY}")
    table = table.replace_schema_metadata({_HEADER: json.dumps(header).encode()})
    pq.write_table(table, temporary, compression="none", use_dictionary=False)
    temporary.replace(path)


def read_header(path: Path) -> dict[str, Any]:
    """What ``write_table`` was told about the rows.

    Raises:
        pyarrow.ArrowInvalid: the file is damaged.
    """
    header: dict[str, Any] = json.loads(pq.read_schema(path).metadata[_HEADER])
    return header


def write_failure(directory: Path, outcome: Outcome) -> None:
    """Commit the news of a failed attempt, so that a resumed recording need not repeat it."""
    path = directory / f"{_STEM.format(outcome.attempt)}.json"
    write_json(path, dataclasses.asdict(outcome))


@contextmanager
def appearing_whole(path: Path) -> Iterator[TextIO]:
    """A text file to write; it appears at ``path`` when all is written, or not at all."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}{_TEMPORARY}")
    with temporary.open("w", encoding="utf-8") as file:
        yield file
    temporary.replace(path)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content``; the file appears whole or not at all."""
    with appearing_whole(path) as file:
        file.write(json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def delete_leftovers(directory: Path) -> None:
    """Delete what killed writers left behind."""
    for leftover in directory.glob(f"*{_TEMPORARY}"):
        leftover.unlink()


def as_arrays(statistics: Mapping[str, Mapping[str, Any]]) -> Statistics:
    """Statistics as JSON gives them back, as arrays."""
    return {key: {name: np.array(value) for name, value in found.items()} for key, found in statistics.items()}


def as_lists(statistics: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, dict[str, Any]]:
    """Statistics in the form of JSON."""
    return {key: {name: value.tolist() for name, value in found.items()} for key, found in statistics.items()}


def read_outcomes(directory: Path) -> dict[int, Outcome]:
    """All finished attempts by index. Damaged shards and what killed writers left behind are deleted."""
    delete_leftovers(directory)
    outcomes = {}
    for path in sorted([*directory.glob("attempt-*.parquet"), *directory.glob("attempt-*.json")]):
        try:
            outcome = _read_outcome(path)
        except (pa.ArrowInvalid, json.JSONDecodeError):
            path.unlink()
        else:
            outcomes[outcome.attempt] = outcome
    return outcomes


def missing_attempts(outcomes: Mapping[int, Outcome], episodes: int, tasks: int = 1) -> list[int]:
    """The attempts to make next, if each of them were to succeed, task by task.

    Attempt i is at task i modulo ``tasks``. The dataset is the first ``episodes`` successes of every task, in order of
    their attempts. Every gap before the last of them must be filled, whoever left it: that makes the result independent
    of the number of workers and of kills.
    """
    return [attempt for attempt in _needed_attempts(outcomes, episodes, tasks) if attempt not in outcomes]


def _needed_attempts(outcomes: Mapping[int, Outcome], episodes: int, tasks: int) -> Iterator[int]:
    """Attempts up to each task's last episode, task by task, if those not made yet were to succeed."""
    for task in range(tasks):
        attempts = count(task, tasks)
        successes = 0
        while successes < episodes:
            attempt = next(attempts)
            successes += attempt not in outcomes or outcomes[attempt].success
            yield attempt


def made_attempts(outcomes: Mapping[int, Outcome], episodes: int, tasks: int = 1) -> list[Outcome]:
    """The attempts up to those that completed the dataset, in order, failures included.

    Raises:
        ValueError: the outcomes do not hold ``episodes`` successes of every task without gaps.
    """
    if missing := missing_attempts(outcomes, episodes, tasks):
        raise ValueError(f"the recording is not complete: attempts {missing} are missing for {episodes} episodes")
    return [outcomes[attempt] for attempt in sorted(_needed_attempts(outcomes, episodes, tasks))]


def _read_outcome(path: Path) -> Outcome:
    if path.suffix == ".json":
        return Outcome(**json.loads(path.read_text(encoding="utf-8")))
    return Outcome(**read_header(path))
