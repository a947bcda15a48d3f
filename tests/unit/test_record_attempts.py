"""Recordings that make no sense stop before a process is started."""

from pathlib import Path

import pytest

from dataset_tools.attempts import TOLERATED_FAILURES, make_attempts
from dataset_tools.record_settings import SEED_LIMIT
from dataset_tools.record_worker import WorkerSetup
from dataset_tools.shards import Outcome


def outcomes(failures: int, successes: int) -> dict[int, Outcome]:
    kinds = ["time"] * failures + [""] * successes
    return {i: Outcome(i, i, "lift", 0, "lift", ["lift"], kind, 3) for i, kind in enumerate(kinds)}


def start(seed: int, made: dict[int, Outcome], episodes: int) -> None:
    def no_env(task: str) -> None:
        raise AssertionError("no process may be started")

    next(make_attempts(WorkerSetup(Path(), ("lift",), no_env, ("front",), 1, seed), 2, made, episodes))


def test_an_expert_that_mostly_fails_is_given_up() -> None:
    with pytest.raises(RuntimeError, match=f"{TOLERATED_FAILURES + 1} of .* attempts failed \\(time: "):
        start(0, outcomes(TOLERATED_FAILURES + 1, 7), 11)


def test_scenes_of_the_evaluation_are_never_recorded() -> None:
    with pytest.raises(ValueError, match=f"needs scene seed {SEED_LIMIT}, .* are for evaluation"):
        start(SEED_LIMIT - 3, outcomes(1, 0), 3)
