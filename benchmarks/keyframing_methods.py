"""Quality and time of keyframing methods, ours and others', on the named paths of ``paths.py``.

    pip install pygad deap pymoo rdp
    python benchmarks/keyframing_methods.py [--count=10]

For each kind, n frames and k keyframes: how much larger the summed error is than the exact optimum's (median and worst
over the paths), and milliseconds on the same finished cost table. Below it the whole method, cost table and the judging
optimum included, and the paper's equations as printed beside our defaults. Results go to
``benchmarks/results/keyframing_methods.json`` and ``.md``.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from keyframing_peers import PEERS
from paths import KINDS, RATE, SMOOTH, paths
from tqdm import tqdm

from dataset_tools import exact, simplify
from dataset_tools.fitness import Problem, path_deviations
from dataset_tools.genetic import GeneticOptions, evolve
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.shards import write_json
from dataset_tools.signals import PauseOptions, Trajectory

RESULTS = Path(__file__).parent / "results" / "keyframing_methods.json"
SIZES = ((50, 5), (100, 10), (300, 30))
"""Frames and keyframes."""
WHOLE = (100, 300, 1000)
"""Frames of the episodes on which the whole method is timed."""
PAPER = GeneticOptions(refine=False)
NEVER = PauseOptions(speed=0.0)
"""The paths hold no pause; tremor shall not make one."""


def paper(problem: Problem, k: int, seed: int) -> Any:
    """Our genetic algorithm as printed: from a random start, without refinement."""
    rng = np.random.default_rng(seed)
    picks = np.sort(rng.choice(problem.free, k - len(problem.mandatory), replace=False))
    return evolve(problem, np.sort(np.concatenate([problem.mandatory, picks])), rng, PAPER)


METHODS: Mapping[str, Callable[[Problem, int, int], Any]] = {
    "ga (default)": lambda problem, k, seed: simplify.genetic(problem, k, (seed,), GeneticOptions()),
    "ga as printed": paper,
    "rdp": lambda problem, k, seed: simplify.rdp(problem, k),
    "uniform": lambda problem, k, seed: simplify.uniform(problem, k),
    "exact": lambda problem, k, seed: exact.solve(problem, k).selection(k),
    **PEERS,
}


def compared(kind: str, frames: int, k: int, count: int) -> list[dict[str, Any]]:
    """A row per method."""
    gaps: dict[str, list[float]] = {name: [] for name in METHODS}
    spent: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed, points in enumerate(tqdm(paths(kind, frames, count), total=count, desc=f"{kind}, {k} of {frames}")):
        problem = Problem.of(points, [0, frames - 1])
        best = exact.solve(problem, k).errors[k]
        for name, method in METHODS.items():
            begin = time.process_time()
            selection = method(problem, k, seed)
            spent[name].append(time.process_time() - begin)
            assert len(selection) == k, f"{name} chose {len(selection)} of {k}"
            gaps[name].append(problem.error(selection) / best - 1)
    return [
        {
            "path": kind,
            "frames": frames,
            "keyframes": k,
            "method": name,
            "median_gap_percent": round(100 * float(np.median(gaps[name])), 2),
            "worst_gap_percent": round(100 * max(gaps[name]), 2),
            "median_ms": round(1000 * float(np.median(spent[name])), 2),
        }
        for name in METHODS
    ]


def whole(kind: str, frames: int, count: int) -> dict[str, Any]:
    """Processor time of everything from poses to keyframes."""
    options = KeyframeOptions(pause=NEVER)
    done = [extract(episode(points), options, seed) for seed, points in enumerate(paths(kind, frames, count))]
    return {
        "path": kind,
        "frames": frames,
        "median_ms": round(1000 * float(np.median([one.seconds for one in done])), 1),
        "worst_ms": round(1000 * max(one.seconds for one in done), 1),
        "median_keyframes": float(np.median([len(one.keyframes) for one in done])),
        "median_gap_percent": round(100 * float(np.median([one.gap for one in done])), 2),
    }


def printed_and_default(kind: str, frames: int, count: int) -> list[dict[str, Any]]:
    """The paper's Eq. 1 (infinite lines) and plain genetic algorithm beside our defaults, at the same epsilon."""
    default = KeyframeOptions(pause=NEVER)
    variants = {
        "default": default,
        "Eq. 1 (infinite lines)": replace(default, distance="line"),
        "GA as printed": replace(default, genetic=PAPER),
        "both as printed": replace(default, distance="line", genetic=PAPER),
    }
    rows = []
    for name, options in variants.items():
        episodes = [episode(points) for points in paths(kind, frames, count)]
        done = [extract(one, options, seed) for seed, one in enumerate(episodes)]
        far = [
            stray(one, [frame.pose_frame for frame in found.keyframes])
            for one, found in zip(episodes, done, strict=True)
        ]
        rows.append(
            {
                "path": kind,
                "frames": frames,
                "variant": name,
                "keyframes": float(np.median([len(one.keyframes) for one in done])),
                "mean_error_told_mm": round(1000 * float(np.median([one.error_mean for one in done])), 2),
                "mean_error_to_segments_mm": round(1000 * float(np.median([mean for mean, _ in far])), 2),
                "largest_error_to_segments_mm": round(1000 * max(largest for _, largest in far), 1),
            }
        )
    return rows


def stray(one: Trajectory, kept: Sequence[int]) -> tuple[float, float]:
    """Mean and largest distance [m] of the path to the pieces that an arm follows between keyframes."""
    away = path_deviations(one.position, np.array(kept), "segment")
    return float(away.mean()), float(away.max())


def episode(points: Any) -> Trajectory:
    """An episode that follows these points; no rotation, no gripper."""
    return Trajectory(points, RATE)


def markdown(results: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """All tables."""
    return "\n\n".join(
        f"## {title.replace('_', ' ')}\n\n"
        + "\n".join(
            [
                f"| {' | '.join(name.replace('_', ' ') for name in rows[0])} |",
                "|" + "---|" * len(rows[0]),
                *(f"| {' | '.join(map(str, row.values()))} |" for row in rows),
            ]
        )
        for title, rows in results.items()
    )


def main() -> None:
    """Measure, print, write down."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10, help="paths per kind and length")
    count = parser.parse_args().count
    results = {
        "same_table": [row for kind in SMOOTH for n, k in SIZES for row in compared(kind, n, k, count)],
        "whole_method": [whole(kind, frames, count) for kind in SMOOTH for frames in WHOLE],
        "as_printed": [row for kind in KINDS for row in printed_and_default(kind, 100, count)],
    }
    write_json(RESULTS, results)
    RESULTS.with_suffix(".md").write_text(f"# Keyframing methods, {count} paths per row\n\n{markdown(results)}\n")
    print(markdown(results))


if __name__ == "__main__":
    main()
