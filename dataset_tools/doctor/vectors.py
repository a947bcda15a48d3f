"""Checks of an episode's numbers: whole, finite, evenly in time, not repeated."""

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int64

from dataset_tools.doctor.findings import Finding
from lerobot_histmv import geometry, keys

LATE = 0.1
"""Share of a frame's time by which a step between time stamps may differ from it."""
JUMP = 0.03
"""Steps of the tool below this are no jumps [m]."""
JUMP_RATIO = 8
"""How many times longer than the episode's fast steps (95th percentile) a jump is."""
MANY_REPEATED = 0.2
"""Share of rows that may repeat the one before them: a resting robot with coarse encoders."""
FEWEST_REPEATED = 3
"""Fewer repeated rows are not worth a word."""


def rows_not_whole(frame_index: Int64[np.ndarray, " n"], length: int, episode: int) -> list[Finding]:
    """Rows are the frames 0, 1, ... in order."""
    if np.array_equal(frame_index, np.arange(length)):
        return []
    message = f"its {length} frames are stored as {len(frame_index)} rows"
    if len(frame_index) == length:
        first = int(np.flatnonzero(frame_index != np.arange(length))[0])
        message = f"row {first} holds frame {frame_index[first]}"
    return [Finding.of("rows", message, episode)]


def not_finite(
    vectors: Mapping[str, Float[np.ndarray, "n _"]], names: Mapping[str, Sequence[str]], episode: int
) -> list[Finding]:
    """Every number exists and is finite; of each feature the first that is not, and how many there are."""
    found = []
    for feature, values in vectors.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            frame, entry = bad[0].tolist()
            which = names[feature][entry] if names[feature] else entry
            count = f", the first of {len(bad)}" if len(bad) > 1 else ""
            found.append(Finding.of("nan", f"{feature}[{which}] is {values[frame, entry]}{count}", episode, frame))
    return found


def gripper_range(
    vectors: Mapping[str, Float[np.ndarray, "n _"]], names: Mapping[str, Sequence[str]], episode: int
) -> list[Finding]:
    """Grippers that bear our own name are from 0, closed, to 1, open."""
    found = []
    for feature in (keys.STATE, keys.ACTION):
        if keys.GRIPPER_NAME in names.get(feature, ()):
            values = vectors[feature][:, names[feature].index(keys.GRIPPER_NAME)]
            if (worst := geometry.odd_gripper(values)) is not None:
                message = f"{feature}[{keys.GRIPPER_NAME}] is {values[worst]:.3g}"
                found.append(Finding.of("gripper_range", message, episode, worst))
    return found


def time_gaps(timestamp: Float[np.ndarray, " n"], fps: float, episode: int) -> list[Finding]:
    """Time stamps [s] are 1 / fps apart."""
    steps = np.diff(timestamp)
    bad = np.flatnonzero(~(np.abs(steps * fps - 1) <= LATE))
    if not len(bad):
        return []
    worst = bad[np.argmax(np.abs(np.nan_to_num(steps[bad], nan=np.inf)))]
    message = f"{steps[worst]:.3g} s to the next frame instead of {1 / fps:.3g} s; {len(bad)} of {len(steps)} are off"
    return [Finding.of("time_gap", message, episode, int(worst))]


def tool_jumps(position: Float[np.ndarray, "n 3"], episode: int) -> list[Finding]:
    """The tool moves smoothly [m]."""
    steps = np.linalg.norm(np.diff(position, axis=0), axis=-1)
    if len(steps) < JUMP_RATIO:
        return []
    usual = float(np.percentile(steps, 95, method="lower"))
    bad = np.flatnonzero(steps > max(JUMP, JUMP_RATIO * usual))
    if not len(bad):
        return []
    worst = bad[np.argmax(steps[bad])]
    message = f"{steps[worst]:.3f} m to the next frame, where {usual:.3f} m is fast"
    return [Finding.of("tool_jump", message, episode, int(worst))]


def repeated_rows(vectors: Mapping[str, Float[np.ndarray, "n _"]], episode: int) -> list[Finding]:
    """Rows differ from those before them."""
    values = np.hstack(list(vectors.values()))
    repeated = np.flatnonzero((values[1:] == values[:-1]).all(axis=1)) + 1
    if len(repeated) < max(FEWEST_REPEATED, MANY_REPEATED * (len(values) - 1)):
        return []
    message = f"{len(repeated)} of {len(values)} rows repeat the one before them"
    return [Finding.of("duplicate_rows", message, episode, int(repeated[0]))]


def same_episodes(digests: Mapping[int, str]) -> list[Finding]:
    """No two episodes are equal, given what ``digest`` says of each."""
    first: dict[str, int] = {}
    found = []
    for episode, one in digests.items():
        if first.setdefault(one, episode) != episode:
            found.append(Finding.of("duplicate_episode", f"the same numbers as episode {first[one]}", episode))
    return found


def digest(vectors: Mapping[str, Float[np.ndarray, "n _"]]) -> str:
    """A text that is the same for equal episodes only."""
    whole = hashlib.sha256()
    for values in vectors.values():
        whole.update(np.ascontiguousarray(values).tobytes())
    return whole.hexdigest()
