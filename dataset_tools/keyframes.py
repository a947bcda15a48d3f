"""From one recorded episode to its keyframes: mandatory ones first, then as few more as the error allows."""

import math
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dataset_tools import exact, simplify
from dataset_tools.fitness import Distance, Problem, path_deviations
from dataset_tools.genetic import GeneticOptions
from dataset_tools.signals import Keyframe, PauseOptions, Trajectory, mandatory_keyframes
from dataset_tools.simplify import Method

FEWEST, MOST = 2, 30
"""Numbers of keyframes the paper allows; more mandatory ones are all kept."""
OWN_NUMBER = ("awe", "heuristic")
"""Methods that find their number of keyframes by themselves."""


@dataclass(frozen=True)
class KeyframeOptions:
    """How keyframes are chosen.

    Args:
        method: ``ga`` genetic algorithm; ``exact`` dynamic program; ``heuristic`` mandatory keyframes only; ``rdp``
            Ramer-Douglas-Peucker; ``awe`` fewest under a largest error; ``uniform`` evenly spread in time.
        epsilon: mean error per frame that is accepted [m]; for ``awe`` the largest error of any frame.
        distance: ``segment`` measures to the piece between two keyframes, ``line`` to the infinite line (Eq. 1).
        rotation_scale: how many metres a radian of rotation counts as; 0 ignores rotation, as the paper does.
        seed: makes the genetic algorithm repeatable.
        most: keyframes per episode at most, unless more are mandatory.
        k: exactly so many keyframes per episode instead, unless more are mandatory or the episode has fewer frames;
            epsilon then decides nothing.
        nodes: longer paths are thinned to about so many frames for the search (its time grows with the cube).
        pause: what a pause is.
        genetic: settings of the genetic algorithm.
    """

    method: Method = "ga"
    epsilon: float = 0.005
    distance: Distance = "segment"
    rotation_scale: float = 0.0
    seed: int = 0
    most: int = MOST
    k: int | None = None
    nodes: int = 600
    pause: PauseOptions = field(default_factory=PauseOptions)
    genetic: GeneticOptions = field(default_factory=GeneticOptions)

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"epsilon is {self.epsilon}; it must be above 0 metres")
        if not self.rotation_scale >= 0:
            raise ValueError(f"rotation_scale is {self.rotation_scale}; it must be at least 0 metres per radian")
        if self.most < FEWEST:
            raise ValueError(f"most is {self.most}; at least {FEWEST} keyframes are needed")
        if self.k is not None and self.k < FEWEST:
            raise ValueError(f"k is {self.k}; at least {FEWEST} keyframes are needed")
        if self.k is not None and self.method in OWN_NUMBER:
            raise ValueError(f"k is {self.k}, but the method {self.method} finds its number of keyframes by itself")
        if self.nodes < 2 * self.most:
            raise ValueError(f"nodes is {self.nodes}; it must be at least twice `most` ({self.most})")


@dataclass(frozen=True)
class Keyframing:
    """Keyframes of one episode and how good they are.

    Attributes:
        keyframes: at least two, in order of time.
        frames: frames of the episode.
        error_sum: summed distance of all moving frames to the simplified path [m].
        error_mean: the same per moving frame [m].
        error_max: largest distance [m].
        optimum_mean: ``error_mean`` of the best selection with as many keyframes, by the dynamic program [m].
        gap: how much larger the summed error is than the optimum's, as a ratio; 0 when both vanish.
        seconds: processor time taken, without reading the data.
        warning: empty, or why the error or the number of keyframes is not as asked.
    """

    keyframes: tuple[Keyframe, ...]
    frames: int
    error_sum: float
    error_mean: float
    error_max: float
    optimum_mean: float
    gap: float
    seconds: float
    warning: str

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> "Keyframing":
        """What ``dataclasses.asdict`` made of one, after JSON."""
        return cls(**{**told, "keyframes": tuple(Keyframe(**frame) for frame in told["keyframes"])})


def extract(
    trajectory: Trajectory, options: KeyframeOptions, episode: int = 0, asked: Collection[int] = ()
) -> Keyframing:
    """Keyframes of one episode; the same arguments always give the same ones.

    Args:
        trajectory: the episode.
        options: how they are chosen.
        episode: its number, which is part of the genetic algorithm's seed.
        asked: frames that must be keyframes.

    Raises:
        ValueError: the episode has fewer than two frames, as one macro step needs two, or lacks an asked one.
    """
    if len(trajectory) < FEWEST:
        raise ValueError(f"the episode has {len(trajectory)} frame(s); a macro step needs at least {FEWEST}")
    begin = time.thread_time()
    mandatory = mandatory_keyframes(trajectory, options.pause, asked)
    frames = moving_frames(mandatory)
    nodes = _thinned(frames, mandatory, options.nodes)
    points = curve(trajectory, options.rotation_scale)
    kept = [frame.pose_frame for frame in mandatory]
    problem = Problem.of(points[nodes], np.searchsorted(nodes, kept).tolist(), options.distance)
    selection = _choose(problem, options, episode)
    optimum = exact.solve(problem, len(selection)).selection(len(selection))
    away = path_deviations(points[frames], np.searchsorted(frames, nodes[selection]), options.distance)
    best = path_deviations(points[frames], np.searchsorted(frames, nodes[optimum]), options.distance)
    known = {frame.pose_frame: frame for frame in mandatory}
    return Keyframing(
        keyframes=tuple(known.get(int(f), Keyframe(int(f), int(f), "ga")) for f in nodes[selection]),
        frames=len(trajectory),
        error_sum=float(away.sum()),
        error_mean=float(away.mean()),
        error_max=float(away.max()),
        optimum_mean=float(best.mean()),
        gap=_gap(problem.error(selection), problem.error(optimum)),
        seconds=time.thread_time() - begin,
        warning=_warning(len(mandatory), len(selection), float(away.mean()), options),
    )


def moving_frames(mandatory: list[Keyframe]) -> Int[np.ndarray, " m"]:
    """Pose frames of the mandatory keyframes and all frames between them, less those of the pauses."""
    spans = [
        np.r_[frame.pose_frame, frame.observation_frame + 1 : following.pose_frame]
        for frame, following in pairwise(mandatory)
    ]
    return np.concatenate([*spans, [mandatory[-1].pose_frame]])


def curve(trajectory: Trajectory, rotation_scale: float) -> Float[np.ndarray, "n d"]:
    """Points whose distances are the keyframing error [m].

    With a scale s [m/rad] the quaternion joins as four more axes of 2 s q: for small angles the distance between two
    such points is s times the angle between them.
    """
    if rotation_scale == 0:
        return trajectory.position
    if trajectory.quaternion is None:
        raise ValueError(f"rotation_scale is {rotation_scale}, but no rotation was recorded; it must be 0")
    turns = np.sum(trajectory.quaternion[1:] * trajectory.quaternion[:-1], axis=-1)
    sign = np.cumprod(np.concatenate([[1.0], np.where(turns < 0, -1.0, 1.0)]))
    return np.hstack([trajectory.position, 2 * rotation_scale * sign[:, None] * trajectory.quaternion])


def _thinned(frames: Int[np.ndarray, " m"], mandatory: list[Keyframe], nodes: int) -> Int[np.ndarray, " n"]:
    """Every s-th frame and the mandatory ones, so that about ``nodes`` remain."""
    stride = -(-len(frames) // nodes)
    return np.union1d(frames[::stride], [frame.pose_frame for frame in mandatory])


def _choose(problem: Problem, options: KeyframeOptions, episode: int) -> Int[np.ndarray, " k"]:
    """Selection by the wanted method: of k keyframes, or the fewest that keep the mean error within epsilon."""
    low = len(problem.mandatory)
    high = max(low, min(options.k or options.most, len(problem.points)))
    limit = options.epsilon * len(problem.points)

    def good(selection: Int[np.ndarray, " k"]) -> bool:
        return problem.error(selection) <= limit

    if options.method == "heuristic":
        return problem.mandatory
    if options.method == "awe":
        return simplify.awe(problem, options.epsilon)
    choose = _chooser(problem, options, episode, high)
    if options.k is not None:
        return choose(high)
    if options.method == "ga":  # it is never worse than its start, so it needs no more than Ramer-Douglas-Peucker
        high = next(len(grown) for grown in simplify.growing(problem) if len(grown) == high or good(grown))
    return simplify.fewest(choose, low, high, good)


def _chooser(problem: Problem, options: KeyframeOptions, episode: int, most: int) -> simplify.Chooser:
    """The wanted method as a function of the number of keyframes, up to ``most``."""
    if options.method == "exact":
        return exact.solve(problem, most).selection
    if options.method == "ga":
        return partial(simplify.genetic, problem, entropy=(options.seed, episode), options=options.genetic)
    return partial(simplify.rdp if options.method == "rdp" else simplify.uniform, problem)


def _gap(error: float, optimum: float) -> float:
    """Relative excess over the optimum; sums below a nanometre count as none."""
    return 0.0 if error - optimum < 1e-9 else error / optimum - 1 if optimum > 0 else math.inf


def _warning(mandatory: int, kept: int, error_mean: float, options: KeyframeOptions) -> str:
    if mandatory > options.most:
        return f"{mandatory} keyframes are mandatory, more than {options.most}: all are kept"
    if options.method == "awe" and kept > options.most:
        return f"{kept} keyframes are needed, more than {options.most}: all are kept"
    if options.k is not None:
        return f"{kept} keyframes are kept, not {options.k}" if kept != options.k else ""
    if options.method not in OWN_NUMBER and error_mean > options.epsilon:
        return f"mean error {error_mean:.4g} with {kept} keyframes is above epsilon {options.epsilon:.4g}"
    return ""
