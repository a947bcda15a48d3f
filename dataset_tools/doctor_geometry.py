"""Checks that views agree about the world: clouds of two cameras, and cameras that move unnoticed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from dataset_tools.doctor_calibration import is_still
from dataset_tools.doctor_findings import Finding, Severity
from lerobot_histmv.geometry import deproject, project

APART, FAR_APART = 0.01, 0.03
"""Median distance between surfaces of two views [m] from which there is a warning, and an error."""
HIDDEN = 0.05
"""What lies farther than this [m] behind what the other view sees there is hidden from it."""
FEWEST = 50
"""Points that two views must have in common for their distance to count."""
CHANGED = 0.03
"""Median change of a still camera's depth [m]; most of what it sees does not move."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """One camera at one instant: depth [m] with 0 as invalid, intrinsics [pixels], ``T_world_cam``."""

    camera: str
    depth: Float[np.ndarray, "y x"]
    intrinsics: Float[np.ndarray, " 4"]
    extrinsics: Float[np.ndarray, "3 4"]


Instant = Sequence[DepthView]
"""All usable cameras at one instant."""


def inverted(extrinsics: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """T_world_cam of a given T_cam_world."""
    rotation = extrinsics[:, :3].T
    return np.column_stack([rotation, -rotation @ extrinsics[:, 3]])


def turned(extrinsics: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """T_world_cam, camera axes as in OpenCV, of one with y up and z backward."""
    return extrinsics * np.array([1.0, -1.0, -1.0, 1.0])


OTHER_CONVENTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "T_cam_world is stored instead of T_world_cam": inverted,
    "camera axes are those of OpenGL (y up, z backward) instead of OpenCV": turned,
}


def views_disagree(instants: Sequence[Instant], episode: int) -> list[Finding]:
    """Where two views see the same surface, they see it at the same place."""
    found = []
    for first, second in pairs(instants):
        gaps = surface_gaps(instants, first, second)
        if len(gaps) < FEWEST or np.median(gaps) <= APART:
            continue
        median = float(np.median(gaps))
        message = f"{100 * median:.1f} cm apart (median of {len(gaps)} common points)"
        for convention, convert in OTHER_CONVENTIONS.items():
            others = surface_gaps(converted(instants, convert), first, second)
            if len(others) >= FEWEST and np.median(others) < min(APART, median / 2):
                message += f", but only {100 * np.median(others):.1f} cm if {convention}"
        severity = Severity.ERROR if median > FAR_APART else Severity.WARNING
        both = f"{first}, {second}"
        found.append(Finding.of("views_disagree", message, episode, camera=both, severity=severity))
    return found


def overlap(instants: Sequence[Instant]) -> bool:
    """Whether any two views have enough points in common."""
    return any(len(surface_gaps(instants, *pair)) >= FEWEST for pair in pairs(instants))


def pairs(instants: Sequence[Instant]) -> list[tuple[str, str]]:
    """Pairs of cameras."""
    return list(combinations(sorted({view.camera for instant in instants for view in instant}), 2))


def surface_gaps(instants: Sequence[Instant], first: str, second: str) -> Float[np.ndarray, " n"]:
    """Distances [m], along the other camera's axis, of points of either view from what the other sees there."""
    gaps = [np.empty(0)]
    for instant in instants:
        views = {view.camera: view for view in instant}
        if {first, second} <= set(views):
            gaps += [one_way(views[first], views[second]), one_way(views[second], views[first])]
    return np.concatenate(gaps)


def one_way(seen: DepthView, other: DepthView) -> Float[np.ndarray, " n"]:
    """``surface_gaps`` of the points of ``seen`` in the image of ``other``, without those hidden from it."""
    points = deproject(seen.depth, seen.intrinsics, seen.extrinsics)[seen.depth > 0]
    pixels, z = project(points, other.intrinsics, other.extrinsics)
    rows, columns = other.depth.shape
    with np.errstate(invalid="ignore"):
        within = ((pixels > -0.5) & (pixels < np.array([columns, rows]) - 0.5)).all(axis=-1)
    u, v = np.rint(pixels[within]).astype(int).T
    surface = other.depth[v, u]
    behind = z[within] - surface
    return np.abs(behind[(surface > 0) & (behind < HIDDEN)])


def converted(instants: Sequence[Instant], convert: Callable[[np.ndarray], np.ndarray]) -> list[Instant]:
    """The instants with all extrinsics converted."""
    return [[replace(view, extrinsics=convert(view.extrinsics)) for view in instant] for instant in instants]


def camera_moves(instants: Sequence[Instant], episode: int) -> list[Finding]:
    """What a camera with constant extrinsics sees stays where it is, for the most part."""
    found = []
    for camera in sorted({view.camera for instant in instants for view in instant}):
        views = [view for instant in instants for view in instant if view.camera == camera]
        if not is_still(np.stack([view.extrinsics for view in views])):
            continue
        change = max(depth_change(views[0].depth, view.depth) for view in views)
        if change > CHANGED:
            message = f"its depth changes by {100 * change:.0f} cm (median), so it moves, but T_world_cam does not"
            found.append(Finding.of("extrinsics_constant", message, episode, camera=camera))
    return found


def depth_change(first: Float[np.ndarray, "y x"], second: Float[np.ndarray, "y x"]) -> float:
    """Median change [m] over pixels that are valid in both; 0 without any."""
    valid = (first > 0) & (second > 0)
    return float(np.median(np.abs(first - second)[valid])) if valid.any() else 0.0
