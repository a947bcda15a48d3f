"""The cost table: distances in closed form, sums as a plain loop makes them, finite where Eq. 1 divides by zero."""

import numpy as np
import pytest

from dataset_tools.fitness import Distance, Problem, cost_table, deviations, fitness, path_deviations


def plain_distance(point: np.ndarray, start: np.ndarray, end: np.ndarray, distance: str) -> float:
    chord = end - start
    length = np.linalg.norm(chord)
    if length < 1e-6:
        return float(np.linalg.norm(point - start))
    along = (point - start) @ chord / length
    if distance == "segment":
        along = min(max(along, 0.0), length)
    return float(np.linalg.norm(point - start - along * chord / length))


@pytest.mark.parametrize(
    ("point", "segment", "line"),
    [([1, 2, 0], 2, 2), ([-3, 4, 0], 5, 4), ([8, 0, 4], 5, 4), ([2, 0, 0], 0, 0)],
    ids=["beside", "before the start", "past the end", "on it"],
)
def test_distance_to_a_segment_of_length_five_along_x(point: list[float], segment: float, line: float) -> None:
    points = np.array([[0, 0, 0], point, [5, 0, 0]], dtype=float)
    assert deviations(points, 0, 2, "segment") == pytest.approx([segment])
    assert deviations(points, 0, 2, "line") == pytest.approx([line])


@pytest.mark.parametrize("distance", ["segment", "line"])
@pytest.mark.parametrize("reduce", [sum, max])
def test_cost_table_equals_a_plain_loop(distance: Distance, reduce: type) -> None:
    points = np.random.default_rng(0).normal(size=(17, 3))
    mandatory = [0, 5, 16]
    table = cost_table(points, mandatory, distance, np.sum if reduce is sum else np.max)
    for i in range(17):
        for j in range(17):
            jumps_over = any(i < node < j for node in mandatory)
            between = [plain_distance(points[f], points[i], points[j], distance) for f in range(i + 1, j)]
            expected = np.inf if i >= j or jumps_over else reduce([0.0, *between])
            assert table[i, j] == pytest.approx(expected, abs=1e-9), (i, j)


def test_long_paths_cross_the_chunks_of_the_table() -> None:
    points = np.cumsum(np.random.default_rng(1).normal(size=(151, 3)), axis=0)
    table = cost_table(points, [0, 150])
    for i, j in ((0, 150), (3, 67), (3, 68), (3, 69), (60, 149)):
        assert table[i, j] == pytest.approx(deviations(points, i, j).sum())


@pytest.mark.parametrize("distance", ["segment", "line"])
def test_a_closed_loop_has_finite_costs(distance: Distance) -> None:
    angle = np.linspace(0, 2 * np.pi, 23)
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    points[-1] = points[0]
    table = cost_table(points, [0, 22], distance)
    assert np.isfinite(table[np.triu_indices(23, 1)]).all()
    assert table[0, 22] == pytest.approx(np.linalg.norm(points[1:-1] - points[0], axis=-1).sum())


def test_the_printed_line_distance_misses_a_press_and_the_segment_does_not() -> None:
    depth = np.array([0.0, 1, 2, 3, 2, 1, 0.5])
    points = np.stack([0 * depth, 0 * depth, -depth], axis=-1)
    assert cost_table(points, [0, 6], "line")[0, 6] == pytest.approx(0)
    assert cost_table(points, [0, 6], "segment")[0, 6] > 5


def test_error_of_a_selection_is_the_sum_of_its_deviations() -> None:
    points = np.random.default_rng(2).normal(size=(29, 3))
    problem = Problem.of(points, [0, 11, 28])
    selection = np.array([0, 7, 11, 13, 28])
    away = path_deviations(points, selection)
    assert problem.error(selection) == pytest.approx(away.sum())
    assert (away[selection] == 0).all()
    batch = np.stack([selection, np.array([0, 1, 11, 12, 28])])
    assert problem.errors(batch)[0] == pytest.approx(away.sum())


def test_fitness_is_finite_for_a_perfect_selection_and_falls_with_the_error() -> None:
    values = fitness(np.array([0.0, 0.1, 0.2]))
    assert np.isfinite(values).all()
    assert (np.diff(values) < 0).all()
