"""Checks of tool poses: quaternions' norm, sign and order, and whether actions are reached."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from dataset_tools.doctor.findings import Finding, Severity
from lerobot_histmv.geometry import (
    UNIT_TOLERANCE,
    angle_between,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

NEGATIVE = 1e-4
"""w may be below zero by this much: rounding."""
LOOSE, FIRM = 0.2, 0.05
"""A camera on the tool turns against it by more than the first [rad] in a wrong order, and less than the second."""
REACHED, REACHED_ANGLE = 0.02, 0.2
"""How close [m], [rad] the tool must come to a commanded pose."""
SOME, MOST = 0.1, 0.5
"""Share of frames with commands that are not reached from which there is a warning, and an error."""

ORDERS = {"w, x, y, z": (0, 1, 2, 3), "x, y, z, w": (3, 0, 1, 2), "other": (1, 2, 3, 0)}


def quaternion_norm(quaternion: Float[np.ndarray, "n 4"], what: str, episode: int) -> list[Finding]:
    """Quaternions are unit."""
    norms = np.linalg.norm(quaternion, axis=-1)
    bad = np.flatnonzero(np.abs(norms - 1) >= UNIT_TOLERANCE)
    if not len(bad):
        return []
    message = f"{what} has norm {norms[bad[0]]:.3g}; {len(bad)} of {len(norms)} frames are off"
    return [Finding.of("quaternion_norm", message, episode, int(bad[0]))]


def quaternion_sign(quaternion: Float[np.ndarray, "n 4"], what: str, episode: int) -> list[Finding]:
    """Quaternions w, x, y, z are canonical, w >= 0."""
    bad = np.flatnonzero(quaternion[:, 0] < -NEGATIVE)
    if not len(bad):
        return []
    flips = int(np.sum(np.sum(quaternion[1:] * quaternion[:-1], axis=-1) < 0))
    message = f"{what} has w < 0 in {len(bad)} of {len(quaternion)} frames and changes sign {flips} times"
    if (quaternion[:, 3] >= 0).all():
        message += "; its last entry never is negative: perhaps that is w"
    return [Finding.of("quaternion_sign", message, episode, int(bad[0]))]


def quaternion_order(
    quaternion: Float[np.ndarray, "n 4"],
    camera_rotations: Mapping[str, Float[np.ndarray, "n 3 3"]],
    what: str,
    episode: int,
) -> list[Finding]:
    """A camera on the tool keeps its rotation to it, if quaternions are read in the right order.

    Args:
        quaternion: of the tool, unit, in the order that is believed to be w, x, y, z.
        camera_rotations: of ``T_world_cam``, by camera.
        what: name of the quaternion's columns.
        episode: which episode.
    """
    for camera, rotations in camera_rotations.items():
        turns = {name: turn_against_tool(quaternion[:, order], rotations) for name, order in ORDERS.items()}
        believed, *others = turns
        better = min(others, key=turns.__getitem__)
        if turns[believed] > LOOSE and turns[better] < FIRM:
            message = (
                f"{what}: {camera} turns {np.degrees(turns[believed]):.0f} degrees against the tool, but "
                f"{np.degrees(turns[better]):.1f} if the order is {better}"
            )
            return [Finding.of("quaternion_order", message, episode)]
    return []


def turn_against_tool(tool: Float[np.ndarray, "n 4"], rotations: Float[np.ndarray, "n 3 3"]) -> float:
    """Largest angle [rad] by which a camera's rotation in the tool's frame changes."""
    in_tool = quaternion_from_matrix(np.swapaxes(matrix_from_quaternion(tool), -1, -2) @ rotations)
    return float(angle_between(in_tool, in_tool[:1]).max())


def action_not_reached(
    commanded: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]],
    measured: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]],
    within: int,
    episode: int,
) -> list[Finding]:
    """The tool comes close to each commanded pose in one of the ``within`` next frames.

    Args:
        commanded: positions [m] and unit quaternions of the actions.
        measured: those of the states.
        within: frames; 1 means the next one.
        episode: which episode.
    """
    distance, angle = nearest(commanded, measured, within)
    missed: Bool[np.ndarray, " n"] = (distance > REACHED) | (angle > REACHED_ANGLE)
    share = float(missed.mean()) if len(missed) else 0.0
    if share <= SOME:
        return []
    frame = int(np.argmax(np.maximum(distance / REACHED, angle / REACHED_ANGLE)))
    message = (
        f"{share:.0%} of the commands are missed by more than {100 * REACHED:g} cm or "
        f"{np.degrees(REACHED_ANGLE):.0f} degrees; here by {100 * distance[frame]:.1f} cm and "
        f"{np.degrees(angle[frame]):.0f} degrees"
    )
    # An arm that presses or pulls is told to go farther than it gets: up to half of the commands is no defect.
    severity = Severity.ERROR if share > MOST else Severity.NOTE
    return [Finding.of("action_not_reached", message, episode, frame, severity=severity)]


def nearest(
    commanded: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]],
    measured: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]],
    within: int,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Smallest distance [m] and angle [rad] from each command but the last to the next ``within`` states."""
    n = len(commanded[0])
    commands = np.arange(n - 1)
    distance, angle = np.full(n - 1, np.inf), np.full(n - 1, np.inf)
    for later in range(1, within + 1):
        states = np.minimum(commands + later, n - 1)
        apart = np.linalg.norm(commanded[0][commands] - measured[0][states], axis=-1)
        turned = angle_between(commanded[1][commands], measured[1][states])
        distance, angle = np.minimum(distance, apart), np.minimum(angle, turned)
    return distance, angle
