"""Results survive kills, intervals are Wilson's, and the summary keeps LeRobot's names."""

import dataclasses
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataset_tools.eval_results import (
    Episode,
    EpisodeLog,
    evaluation_info,
    read_episodes,
    wilson_interval,
)


def episode(seed: int = 7, task: str = "lift", failure: str = "", **changes: object) -> Episode:
    plain = Episode(
        task=task,
        seed=seed,
        success=not failure,
        failure=failure,
        steps=3,
        sum_reward=1.0,
        max_reward=1.0,
        instruction="lift the crème-coloured cube",
        decision_ms=11.0,
        seconds=2.0,
        views=["front", "wrist", "front"],
    )
    return dataclasses.replace(plain, **changes)


@pytest.mark.parametrize(
    ("successes", "episodes", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_interval_equals_newcombes_table(successes: int, episodes: int, low: float, high: float) -> None:
    """Newcombe 1998, Statistics in Medicine 17, table I, method 3."""
    assert wilson_interval(successes, episodes) == pytest.approx((low, high), abs=5e-5)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_laws(counts: tuple[int, int]) -> None:
    successes, episodes = counts
    low, high = wilson_interval(successes, episodes)
    assert 0 <= low <= successes / episodes <= high <= 1
    assert wilson_interval(episodes - successes, episodes) == pytest.approx((1 - high, 1 - low))
    wider = wilson_interval(10 * successes, 10 * episodes)
    assert wider[1] - wider[0] < high - low


def test_wilson_interval_of_nothing_says_nothing() -> None:
    assert wilson_interval(0, 0) == (0, 1)
    with pytest.raises(ValueError, match="5 successes of 3"):
        wilson_interval(5, 3)


def test_log_cut_at_any_byte_keeps_all_whole_lines_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    written = [episode(seed) for seed in (2, 3, 5)]
    log = EpisodeLog(path)
    for one in written:
        log.append(one)
    whole = path.read_bytes()
    for size in range(0, len(whole) + 1, 13):
        path.write_bytes(whole[:size])
        found = read_episodes(path)
        assert found == written[: whole[:size].count(b"\n")]
        EpisodeLog(path).append(episode(11))
        assert read_episodes(path) == [*found, episode(11)]


def test_latest_line_of_a_seed_counts(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path / "episodes.jsonl")
    log.append(episode(3))
    log.append(episode(3, video="videos/lift/3.mp4"))
    assert EpisodeLog(log.path).finished == {("lift", 3): episode(3, video="videos/lift/3.mp4")}


def test_damaged_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    EpisodeLog(path).append(episode())
    path.write_bytes(path.read_bytes() + b'{"task": "lift"}\n')
    with pytest.raises(ValueError, match=r"line 2 of .*episodes.jsonl"):
        read_episodes(path)


def test_info_has_lerobots_names_and_units_and_ours() -> None:
    lift = [episode(2), episode(3, failure="grasp missed", sum_reward=0.0), episode(5, failure="ik", sum_reward=0.0)]
    reach = [episode(2, "reach", video="videos/reach/2.mp4")]
    info = evaluation_info({("ur5", 0): lift, ("ur5", 1): reach}, Path("out"), {"seeds": [2, 5]})

    lerobot = {"avg_sum_reward", "avg_max_reward", "pc_success", "n_episodes", "eval_s", "eval_ep_s", "video_paths"}
    assert lerobot <= info["overall"].keys()
    assert info["overall"]["pc_success"] == 50 and info["overall"]["avg_sum_reward"] == 0.5
    assert info["overall"]["failures"] == {"grasp missed": 1, "ik": 1}
    assert info["overall"]["eval_s"] == 8 and info["per_group"]["ur5"]["n_episodes"] == 4
    assert info["per_task"][0]["metrics"]["successes"] == [True, False, False]
    assert [(entry["task_group"], entry["task_id"], entry["task"]) for entry in info["per_task"]] == [
        ("ur5", 0, "lift"),
        ("ur5", 1, "reach"),
    ]
    assert info["per_task"][1]["metrics"]["video_paths"] == ["out/videos/reach/2.mp4"]
    assert info["per_task"][0]["wilson_95"] == pytest.approx([6.149, 79.234], abs=1e-3)
    assert info["seeds"] == [2, 5]
