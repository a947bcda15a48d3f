"""Choosing keyframes of whole episodes: the number, the gap to the optimum, warnings, repeatability."""

from itertools import pairwise
from typing import get_args

import numpy as np
import pytest

from dataset_tools import exact, simplify
from dataset_tools.fitness import Problem, path_deviations
from dataset_tools.genetic import GeneticOptions
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.signals import Trajectory

METHODS = get_args(simplify.Method)


def bends(seed: int, n: int = 97, corners: int = 7) -> Trajectory:
    """Smooth path through random corners at uneven times, with a millimetre of noise: no pause, no gripper."""
    rng = np.random.default_rng(seed)
    knots = np.sort(np.r_[0, rng.uniform(0, 1, corners - 2), 1])
    at = np.linspace(0, 1, n)
    path = np.stack([np.interp(at, knots, rng.uniform(-0.3, 0.3, corners)) for _ in range(3)], axis=-1)
    kernel = np.hanning(9) / np.hanning(9).sum()
    padded = np.pad(path, ((4, 4), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(axis, kernel, "valid") for axis in padded.T], axis=-1)
    return Trajectory(smooth + rng.normal(0, 0.001, smooth.shape), fps=20.0)


def poses(trajectory: Trajectory, **options: object) -> list[int]:
    return [frame.pose_frame for frame in extract(trajectory, KeyframeOptions(**options)).keyframes]  # type: ignore[arg-type]


def test_the_genetic_algorithm_comes_within_two_per_cent_of_the_optimum() -> None:
    found = [extract(bends(seed), KeyframeOptions(epsilon=0.004), seed) for seed in range(11)]
    counted = [one.gap for one in found if one.optimum_mean > 0.001]
    assert len(counted) > 5
    assert np.median(counted) < 0.02
    assert all(one.gap >= 0 for one in found)


def test_epsilon_is_kept_with_the_fewest_keyframes_that_the_method_finds() -> None:
    trajectory, options = bends(3), KeyframeOptions(epsilon=0.004)
    found = extract(trajectory, options)
    assert found.error_mean <= 0.004
    assert not found.warning
    problem = Problem.of(trajectory.position, [0, 96])
    fewer = simplify.genetic(problem, len(found.keyframes) - 1, (0, 0), GeneticOptions())
    assert problem.error(fewer) > 0.004 * 97


def test_a_smaller_epsilon_never_gives_fewer_keyframes() -> None:
    counts = [len(poses(bends(5), method="exact", epsilon=epsilon)) for epsilon in (0.02, 0.01, 0.005, 0.0025)]
    assert counts == sorted(counts)


def test_the_same_seed_and_episode_give_the_same_keyframes() -> None:
    first, second = (extract(bends(2), KeyframeOptions(seed=7), episode=5) for _ in range(2))
    assert first.keyframes == second.keyframes


def test_an_unreachable_epsilon_keeps_the_most_and_warns() -> None:
    found = extract(bends(1), KeyframeOptions(epsilon=1e-6, most=11))
    assert len(found.keyframes) == 11
    assert "above epsilon" in found.warning


def test_more_mandatory_keyframes_than_allowed_are_all_kept_with_a_warning() -> None:
    trajectory = bends(1)
    gripper = (np.arange(97) // 5 % 2).astype(float)
    found = extract(Trajectory(trajectory.position, 20.0, gripper=gripper), KeyframeOptions(most=7))
    changes = (np.flatnonzero(np.diff(gripper)) + 1).tolist()
    assert [frame.pose_frame for frame in found.keyframes] == [0, *changes, 96]
    assert "more than 7" in found.warning


def test_the_apex_of_a_press_without_a_pause_is_kept() -> None:
    depth = 0.05 * (1 - np.abs(np.linspace(-1, 1, 21)))
    approach = np.linspace([0.0, 0, 0.1], [0.2, 0, 0.1], 11)
    press = np.stack([np.full(21, 0.2), np.zeros(21), 0.1 - depth], axis=-1)
    path = np.concatenate([approach, press[1:]])
    assert 20 in poses(Trajectory(path, 20.0), epsilon=0.002)
    assert 20 in poses(Trajectory(path, 20.0), method="exact", epsilon=0.002)


@pytest.mark.parametrize("method", METHODS)
def test_a_stationary_episode_and_one_of_two_frames_give_two_keyframes(method: str) -> None:
    still = np.tile([0.4, 0.1, 0.2], (13, 1))
    assert poses(Trajectory(still, 20.0), method=method) == [0, 12]
    assert poses(Trajectory(still[:2], 20.0), method=method) == [0, 1]
    for found in (extract(Trajectory(path, 20.0), KeyframeOptions(method=method)) for path in (still, still[:2])):  # type: ignore[arg-type]
        assert (found.error_sum, found.error_max, found.gap) == (0, 0, 0)


@pytest.mark.parametrize("method", METHODS)
def test_a_closed_loop_keeps_frames_far_from_its_ends(method: str) -> None:
    turn = np.linspace(0, 2 * np.pi, 61)
    loop = np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), np.zeros(61)], axis=-1)
    kept = poses(Trajectory(loop, 20.0), method=method, epsilon=0.01)
    assert (kept[0], kept[-1]) == (0, 60)
    assert len(kept) == 2 if method == "heuristic" else np.ptp(loop[kept], axis=0)[:2].min() > 0.1


@pytest.mark.parametrize("method", METHODS)
def test_a_long_episode_is_thinned_for_the_search_alone(method: str) -> None:
    long = bends(5, n=5003, corners=11)
    found = extract(long, KeyframeOptions(method=method))  # type: ignore[arg-type]
    kept = [frame.pose_frame for frame in found.keyframes]
    away = path_deviations(long.position, np.array(kept))
    assert (kept[0], kept[-1]) == (0, 5002)
    assert found.frames == 5003
    assert len(kept) <= 30 or found.warning
    assert np.isclose(found.error_mean, away.mean())
    assert np.isclose(found.error_max, away.max())


def test_jitter_costs_few_keyframes() -> None:
    calm, rng = bends(3), np.random.default_rng(3)
    shaken = Trajectory(calm.position + rng.normal(0, 0.002, calm.position.shape), 20.0)
    assert abs(len(poses(shaken)) - len(poses(calm))) <= 2


def test_one_frame_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1 frame\(s\)"):
        extract(Trajectory(np.zeros((1, 3)), 20.0), KeyframeOptions())


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_the_same_kind_of_result(method: str) -> None:
    found = extract(bends(4), KeyframeOptions(method=method, epsilon=0.01))  # type: ignore[arg-type]
    frames = [frame.pose_frame for frame in found.keyframes]
    assert (frames[0], frames[-1]) == (0, 96)
    assert frames == sorted(set(frames))
    assert {frame.reason for frame in found.keyframes[1:-1]} <= {"ga"}
    assert 0 <= found.error_mean <= found.error_max
    assert found.gap >= 0
    if method == "heuristic":
        assert frames == [0, 96]
    elif method == "awe":
        assert found.error_max <= 0.01
    else:
        assert found.error_mean <= 0.01


@pytest.mark.parametrize("method", ["ga", "exact", "rdp", "uniform"])
def test_a_fixed_k_is_kept_whatever_epsilon_says(method: str) -> None:
    found = extract(bends(4), KeyframeOptions(method=method, k=11, epsilon=1.0))  # type: ignore[arg-type]
    assert len(found.keyframes) == 11
    assert not found.warning
    short = extract(bends(4, n=7), KeyframeOptions(method=method, k=11))  # type: ignore[arg-type]
    assert len(short.keyframes) == 7
    assert short.warning == "7 keyframes are kept, not 11"


@pytest.mark.parametrize("method", METHODS)
def test_asked_frames_are_kept_by_every_method(method: str) -> None:
    found = extract(bends(4), KeyframeOptions(method=method, epsilon=0.01), asked=(0, 31, 13, 31))  # type: ignore[arg-type]
    assert [frame.pose_frame for frame in found.keyframes if frame.reason == "user"] == [13, 31]
    with pytest.raises(ValueError, match=r"frames \[97\] are asked for, but the episode has frames 0 to 96"):
        extract(bends(4), KeyframeOptions(), asked=(97,))


def test_rotation_enters_through_its_scale() -> None:
    turn = np.concatenate([np.zeros(20), np.linspace(0, 1.5, 21)])
    path = np.linspace([0.0, 0, 0], [0.4, 0, 0], 41)
    quaternion = np.stack([np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)], axis=-1)
    trajectory = Trajectory(path, 20.0, quaternion * np.where(np.arange(41) % 2, 1, -1)[:, None])
    assert poses(trajectory, method="exact") == [0, 40]
    bent = poses(trajectory, method="exact", rotation_scale=0.1)
    assert len(bent) == 3
    assert abs(bent[1] - 20) <= 2


def test_a_rotation_scale_without_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="no rotation was recorded"):
        extract(bends(0), KeyframeOptions(rotation_scale=0.1))


def test_long_paths_are_thinned_for_the_search_and_measured_in_full() -> None:
    long = bends(6, n=997)
    found = extract(long, KeyframeOptions(nodes=101, epsilon=0.01))
    frames = [frame.pose_frame for frame in found.keyframes]
    assert (frames[0], frames[-1]) == (0, 996)
    away = [
        np.linalg.norm(np.cross(long.position[f] - long.position[a], long.position[b] - long.position[a]))
        / np.linalg.norm(long.position[b] - long.position[a])
        for a, b in pairwise(frames)
        for f in range(a + 1, b)
    ]
    assert found.error_max >= max(away) - 1e-9
    assert found.error_sum >= sum(away) - 1e-9


def test_asking_the_judge_for_an_impossible_number_lists_the_possible_ones() -> None:
    problem = Problem.of(bends(0, n=5).position, [0, 2, 4])
    with pytest.raises(ValueError, match=r"no selection of 2 .*\[3, 4, 5\]"):
        exact.solve(problem, 5).selection(2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epsilon": 0.0}, "above 0"),
        ({"epsilon": float("nan")}, "above 0"),
        ({"most": 1}, "at least 2"),
        ({"rotation_scale": -1.0}, "at least 0"),
        ({"nodes": 31}, "twice"),
        ({"k": 1}, "at least 2"),
        ({"k": 5, "method": "awe"}, "finds its number of keyframes by itself"),
    ],
)
def test_options_that_make_no_sense_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        KeyframeOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "value"), [("population", 0), ("crossover", 1.1), ("mutation", -0.1)])
def test_genetic_settings_that_make_no_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"genetic\.{name} is {value}"):
        GeneticOptions(**{name: value})  # type: ignore[arg-type]
