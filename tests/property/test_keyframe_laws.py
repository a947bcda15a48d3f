"""Laws of choosing keyframes, over random paths: what every method keeps, and that none beats the exact optimum."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_tools import exact, simplify
from dataset_tools.fitness import Distance, Problem, path_deviations
from dataset_tools.genetic import GeneticOptions, distinct, evolve

QUICK = GeneticOptions(population=23, generations=7)


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    """Random walks of 2 to 31 nodes, some standing still, with random mandatory nodes."""
    n = draw(st.integers(2, 31))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    steps = rng.normal(size=(n, 3)) * rng.choice([0.0, 0.01, 1.0], size=(n, 1))
    inner = draw(st.sets(st.integers(1, max(1, n - 2)), max_size=3)) if n > 2 else set()
    distance: Distance = draw(st.sampled_from(["segment", "line"]))
    return Problem.of(np.cumsum(steps, axis=0), sorted({0, n - 1} | inner), distance)


def size_of(problem: Problem, draw: st.DataObject) -> int:
    return draw.draw(st.integers(len(problem.mandatory), len(problem.points)))


@settings(max_examples=20, deadline=None)
@given(problem=problems(), data=st.data())
def test_every_method_keeps_k_rising_nodes_with_the_mandatory_ones(problem: Problem, data: st.DataObject) -> None:
    k = size_of(problem, data)
    optimum = exact.solve(problem, k)
    chosen = {
        "ga": simplify.genetic(problem, k, (0, 0), QUICK),
        "exact": optimum.selection(k),
        "rdp": simplify.rdp(problem, k),
        "uniform": simplify.uniform(problem, k),
    }
    for name, selection in chosen.items():
        assert len(selection) == k, name
        assert (np.diff(selection) > 0).all(), name
        assert set(problem.mandatory) <= set(selection), name
        assert problem.error(selection) >= optimum.errors[k] - 1e-9, name
    assert problem.error(chosen["exact"]) == pytest.approx(optimum.errors[k])
    assert problem.error(chosen["ga"]) <= problem.error(chosen["rdp"]) + 1e-12


@settings(max_examples=11, deadline=None)
@given(problem=problems(), data=st.data(), seed=st.integers(0, 99), refine=st.booleans())
def test_the_genetic_algorithm_is_never_worse_than_its_seed(
    problem: Problem, data: st.DataObject, seed: int, refine: bool
) -> None:
    start = simplify.uniform(problem, size_of(problem, data))
    options = GeneticOptions(population=7, generations=5, refine=refine)
    result = evolve(problem, start, np.random.default_rng(seed), options)
    assert problem.error(result) <= problem.error(start) + 1e-12


@settings(max_examples=23, deadline=None)
@given(problem=problems())
def test_the_best_error_never_rises_with_more_keyframes(problem: Problem) -> None:
    errors = exact.solve(problem, len(problem.points)).errors[len(problem.mandatory) :]
    assert np.isfinite(errors).all()
    assert (np.diff(errors) <= 1e-9).all()
    assert errors[-1] == pytest.approx(0)


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_exact_method_equals_brute_force(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(9, 3))
    problem = Problem.of(points, [0, 3, 8])
    optimum = exact.solve(problem, 9)
    for k in range(3, 10):
        candidates = [np.sort([0, 3, 8, *extra]) for extra in combinations(problem.free.tolist(), k - 3)]
        assert optimum.errors[k] == pytest.approx(min(float(problem.error(one)) for one in candidates))


@settings(max_examples=23, deadline=None)
@given(problem=problems(), limit=st.floats(0.001, 3))
def test_awe_keeps_every_frame_within_its_limit_with_the_fewest_nodes(problem: Problem, limit: float) -> None:
    selection = simplify.awe(problem, limit)
    assert set(problem.mandatory) <= set(selection)
    assert largest_deviation(problem, selection) <= limit + 1e-9
    for dropped in set(selection.tolist()) - set(problem.mandatory.tolist()):
        assert largest_deviation(problem, np.setdiff1d(selection, [dropped])) > limit


def largest_deviation(problem: Problem, selection: np.ndarray) -> float:
    return float(path_deviations(problem.points, selection, problem.distance).max())


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_genomes_become_sorted_and_distinct_and_stay_if_they_are(data: st.DataObject) -> None:
    places = data.draw(st.integers(1, 13))
    genes = data.draw(st.integers(1, places))
    raw = data.draw(st.lists(st.integers(-3, places + 3), min_size=genes, max_size=genes))
    row = distinct(np.array([raw]), places)[0]
    assert (np.diff(row) > 0).all()
    assert row.min() >= 0
    assert row.max() < places
    assert (distinct(row[None], places)[0] == row).all()
