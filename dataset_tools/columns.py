"""Which columns of a dataset hold the tool's position, its rotation and the gripper: as told, or guessed from names."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lerobot_histmv import keys

ROTATION_FORMATS = {"wxyz": 4, "xyzw": 4, "rotvec": 3, "rpy": 3}
"""Rotation formats and how many entries each has."""
NONE = "none"
"""Value of a column option that switches the guess off."""

Features = Mapping[str, Mapping[str, Any]]
"""A LeRobot feature dictionary: dtype, shape and names by key."""


@dataclass
class ColumnsConfig:
    """Columns to use: `feature:start:stop`, `feature:index`, `feature:name,name,...` or just `feature`."""

    # Tool position [m]: three entries, e.g. observation.state:0:3 . Guessed from names such as ee.x.pos or tcp_x.
    position: str | None = None
    # Tool rotation, e.g. observation.state:3:7 ; `none` leaves it out. Guessed from names such as ee.qw.pos.
    rotation: str | None = None
    # wxyz or xyzw (quaternions), rotvec [rad] or rpy (roll, pitch, yaw about fixed axes [rad]). Needed without names.
    rotation_format: str | None = None
    # Gripper command, e.g. action:7 ; `none` leaves it out. Guessed from names with "gripper", in action first.
    gripper: str | None = None
    # Gripper values that mean closed and open, e.g. [0,100]. Default: [0,1] under our own names, else the data's range.
    gripper_range: list[float] | None = None
    # Measured gripper opening, e.g. observation.state:7 ; `none` takes the command for it. Guessed like the gripper.
    opening: str | None = None
    # Measured values that mean closed and open. Default: the gripper's if it is the same column, else the data's range.
    opening_range: list[float] | None = None
    # Where the arm rests, label with the commanded pose, not the measured one, if the action has our pose names: an arm
    # that pushes against something does not get to where it was told to go.
    commanded: bool = True
    # Joint angles [rad] to follow instead of a tool position, e.g. observation.state:0:6 . epsilon is then in radians.
    joints: str | None = None

    def __post_init__(self) -> None:
        if self.joints and self.position:
            raise ValueError("columns.position and columns.joints exclude each other: which is the curve to follow?")
        if self.rotation_format not in (None, *ROTATION_FORMATS):
            raise ValueError(
                f"columns.rotation_format is {self.rotation_format!r}; it must be one of {', '.join(ROTATION_FORMATS)}"
            )
        if self.rotation_format and not self.rotation:
            raise ValueError("columns.rotation_format says nothing without columns.rotation; give both")
        for name, ends in (("gripper_range", self.gripper_range), ("opening_range", self.opening_range)):
            if ends is not None and (len(ends) != 2 or ends[0] == ends[1]):
                raise ValueError(f"columns.{name} is {ends}; it must be two different numbers: [closed, open]")


@dataclass(frozen=True)
class Column:
    """Some entries of one vector feature; ``names`` are empty where the dataset has none."""

    feature: str
    indices: tuple[int, ...]
    names: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.feature}:{','.join(self.names or map(str, self.indices))}"

    def of(self, vectors: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n d"]:
        """These entries of an episode's vectors (n, size of the feature)."""
        return np.asarray(vectors[self.feature][:, list(self.indices)], dtype=np.float64)


@dataclass(frozen=True)
class Columns:
    """Resolved columns.

    Attributes:
        curve: tool position [m] or, with ``is_joints``, joint angles [rad].
        is_joints: which of the two.
        rotation: tool rotation, if there is one.
        rotation_format: one of ``ROTATION_FORMATS``; empty without rotation.
        gripper: gripper command, if there is one.
        gripper_range: its values that mean closed and open; None where only the data tell.
        commanded: commanded tool position and rotation (w, x, y, z), if they are to be used.
        opening: measured gripper opening, if there is one.
        opening_range: its values that mean closed and open; None where only the data tell.
    """

    curve: Column
    is_joints: bool
    rotation: Column | None
    rotation_format: str
    gripper: Column | None
    gripper_range: tuple[float, float] | None
    commanded: tuple[Column, Column] | None = None
    opening: Column | None = None
    opening_range: tuple[float, float] | None = None

    def chosen(self) -> dict[str, str]:
        """What was chosen, as text."""
        named = {"joints" if self.is_joints else "position": self.curve, "gripper": self.gripper}
        if self.rotation:
            named[f"rotation ({self.rotation_format})"] = self.rotation
        if self.commanded:
            named["commanded position"], named["commanded rotation"] = self.commanded
        return {name: str(column) for name, column in named.items() if column}


def vectors(features: Features) -> dict[str, tuple[str, ...]]:
    """Numeric one-dimensional features (``action`` and ``observation.*``) and the names of their entries, if named."""
    return {
        key: entry_names(feature)
        for key, feature in features.items()
        if (key == keys.ACTION or key.startswith(keys.OBS_PREFIX))
        and len(feature["shape"]) == 1
        and re.match("float|int|uint", feature["dtype"])
    }


def entry_names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of a vector's entries, also where they are nested in groups; empty unless there is one per entry."""
    names = feature.get("names") or ()
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    return tuple(map(str, names)) if len(names) == feature["shape"][0] else ()


def listing(features: Features) -> str:
    """The vectors of a dataset and their entries, for messages."""
    parts = [f"{key} [{', '.join(names) or features[key]['shape'][0]}]" for key, names in vectors(features).items()]
    return "; ".join(parts) or "no vector at all"


def parse(features: Features, text: str, option: str) -> Column:
    """Column that an option spells out.

    Raises:
        ValueError: it names no vector of the dataset, or entries that this vector does not have.
    """
    feature, _, where = text.partition(":")
    if feature not in vectors(features):
        raise ValueError(f"columns.{option} is {text!r}, but there is no such vector; there are {listing(features)}")
    size, names = features[feature]["shape"][0], entry_names(features[feature])
    indices = _entries(where, names, size)
    if not indices:
        raise ValueError(
            f"columns.{option} is {text!r}, but the entries of {listing({feature: features[feature]})} are given as "
            f"start:stop, one index, or names"
        )
    return Column(feature, tuple(indices), tuple(names[i] for i in indices) if names else ())


def _entries(where: str, names: tuple[str, ...], size: int) -> list[int]:
    """Indices that the part of a column after its feature stands for; none if it does not fit."""
    if not where:
        return list(range(size))
    if re.fullmatch(r"\d+", where):
        return [int(where)] if int(where) < size else []
    if limits := re.fullmatch(r"(\d+):(\d+)", where):
        start, stop = map(int, limits.groups())
        return list(range(start, stop)) if stop <= size else []
    wanted = where.split(",")
    return [names.index(name) for name in wanted] if set(wanted) <= set(names) else []
