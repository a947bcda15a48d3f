"""Checks that views agree about the world: clouds of two cameras, and cameras that move unnoticed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from dataset_tools.doctor.calibration import is_still
from dataset_tools.doctor.findings import Finding, Severity
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
        severity = Severity.ERROR if median > FAR_APART else Severity.WARNING
        both = f"{first}, {second}"
        message += better_convention(instants, first, second)
        found.append(Finding.of("views_disagree", message, episode, camera=both, severity=severity))
    return found


def views_apart(instants: Sequence[Instant], episode: int) -> list[Finding]:
    """Some two views have enough points in common."""
    if not pairs(instants) or any(len(surface_gaps(instants, *pair)) >= FEWEST for pair in pairs(instants)):
        return []
    better = next(filter(None, (better_convention(instants, *pair) for pair in pairs(instants))), "")
    return [Finding.of("views_apart", f"in {len(instants)} frames looked at{better}", episode)]


def better_convention(instants: Sequence[Instant], first: str, second: str) -> str:
    """End of a message: the convention, if any, in which two views would agree."""
    for convention, convert in OTHER_CONVENTIONS.items():
        gaps = surface_gaps(converted(instants, convert), first, second)
        if len(gaps) >= FEWEST and np.median(gaps) < APART:
            return f"; they would agree to {100 * np.median(gaps):.1f} cm if {convention}"
    return ""


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
        within = ((pixels >= 0) & (pixels <= np.array([columns, rows]) - 1)).all(axis=-1)
    behind = z[within] - depth_at(other.depth, pixels[within])
    return np.abs(behind[behind < HIDDEN])


def depth_at(depth: Float[np.ndarray, "y x"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Depth [m] between pixel centres (u, v), NaN beside invalid ones; linear in 1 / z, which is exact on planes."""
    inverse = np.divide(1.0, depth, out=np.full(depth.shape, np.nan), where=depth > 0)
    rows, columns = depth.shape
    corners = np.minimum(np.floor(pixels).astype(int), np.array([columns, rows]) - 2)
    (u, v), (right, down) = corners.T, (pixels - corners).T
    upper = (1 - right) * inverse[v, u] + right * inverse[v, u + 1]
    lower = (1 - right) * inverse[v + 1, u] + right * inverse[v + 1, u + 1]
    return 1 / ((1 - down) * upper + down * lower)


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
