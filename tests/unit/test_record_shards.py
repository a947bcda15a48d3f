"""The first successes in order make the dataset, whatever the order in which attempts end and whoever is killed."""

from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataset_tools.shards import (
    Outcome,
    made_attempts,
    missing_attempts,
    read_outcomes,
    shard_path,
    write_failure,
    write_success,
)


def outcome(attempt: int, failure: str = "") -> Outcome:
    return Outcome(attempt, 100 + attempt, "lift", 1, "lift", ["lift", "raise"], failure, 3, {"x": {"min": [[[1.5]]]}})


@given(st.data(), st.integers(1, 11), st.sets(st.integers(0, 40)), st.integers(1, 5))
def test_order_of_completion_does_not_matter(data: st.DataObject, episodes: int, bad: set[int], at_once: int) -> None:
    outcomes: dict[int, Outcome] = {}
    running: list[int] = []
    while missing := missing_attempts(outcomes, episodes):
        running += [attempt for attempt in missing if attempt not in running][: at_once - len(running)]
        done = running.pop(data.draw(st.integers(0, len(running) - 1)))
        outcomes[done] = outcome(done, "time" if done in bad else "")
    made = made_attempts(outcomes, episodes)
    expected = [attempt for attempt in range(100) if attempt not in bad][:episodes]
    assert [one.attempt for one in made] == list(range(expected[-1] + 1))
    assert [one.attempt for one in made if one.success] == expected


@given(st.dictionaries(st.integers(0, 20), st.booleans()), st.integers(1, 7))
def test_gaps_are_filled_before_anything_new(successes: dict[int, bool], episodes: int) -> None:
    outcomes = {attempt: outcome(attempt, "" if success else "time") for attempt, success in successes.items()}
    missing = missing_attempts(outcomes, episodes)
    assert not set(missing) & set(outcomes)
    assert set(range(max(missing, default=0))) <= set(missing) | set(outcomes)


@given(st.integers(1, 5), st.integers(1, 4), st.sets(st.integers(0, 20)))
def test_every_task_gets_its_episodes(episodes: int, tasks: int, bad: set[int]) -> None:
    outcomes: dict[int, Outcome] = {}
    while missing := missing_attempts(outcomes, episodes, tasks):
        assert [attempt % tasks for attempt in missing] == sorted(attempt % tasks for attempt in missing)
        outcomes[missing[-1]] = outcome(missing[-1], "time" if missing[-1] in bad else "")
    made = made_attempts(outcomes, episodes, tasks)
    assert [one.attempt for one in made] == sorted(outcomes)
    kept = [one.attempt % tasks for one in made if one.success]
    assert sorted(kept) == [task for task in range(tasks) for _ in range(episodes)]


def test_incomplete_recordings_are_refused() -> None:
    with pytest.raises(ValueError, match=r"attempts \[1\] are missing"):
        made_attempts({0: outcome(0), 2: outcome(2)}, 3)


def test_outcomes_come_back_from_disk(tmp_path: Path) -> None:
    write_success(tmp_path, outcome(0), pa.table({"x": [1, 2, 3]}))
    write_failure(tmp_path, outcome(1, "ik"))
    assert read_outcomes(tmp_path) == {0: outcome(0), 1: outcome(1, "ik")}


def test_damaged_shards_and_leftovers_are_dropped(tmp_path: Path) -> None:
    for attempt in (0, 1):
        write_success(tmp_path, outcome(attempt), pa.table({"x": [1, 2, 3]}))
    write_failure(tmp_path, outcome(2, "ik"))
    damaged = shard_path(tmp_path, 1)
    damaged.write_bytes(damaged.read_bytes()[:-7])
    (tmp_path / "attempt-000002.json").write_text('{"attempt": 2')
    (tmp_path / "attempt-000003.parquet.77.tmp").write_bytes(b"PAR1")
    assert read_outcomes(tmp_path) == {0: outcome(0)}
    assert [path.name for path in tmp_path.iterdir()] == ["attempt-000000.parquet"]
