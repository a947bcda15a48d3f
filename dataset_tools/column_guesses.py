"""Guessing a dataset's tool position, rotation and gripper columns from feature names.

Nothing is guessed where the names leave a choice: that is an error which lists the candidates and the option to set.
"""

import re
from collections import defaultdict
from collections.abc import Set

from dataset_tools.columns import (
    NONE,
    ROTATION_FORMATS,
    Column,
    Columns,
    ColumnsConfig,
    Features,
    entry_names,
    listing,
    parse,
    vectors,
)
from lerobot_histmv import keys

_TOOL = {"ee", "eef", "tcp", "tool", "effector", "hand", "gripper", "cartesian"}
_NOT_A_POSE = {
    "vel",
    "velocity",
    "speed",
    "acc",
    "force",
    "torque",
    "effort",
    "goal",
    "target",
    "object",
    "obj",
    "delta",
}
_ROTATION = {"quat", "quaternion", "rot", "rotation", "orientation", "ori", "orn", "euler", "axis", "angle", "rotvec"}
_GRIPPER = {"gripper", "grip", "jaw", "finger", "fingers"}
_ROTATION_AXES = (
    ("wxyz", ("qw", "qx", "qy", "qz"), frozenset[str]()),
    ("wxyz", ("w", "x", "y", "z"), _ROTATION),
    ("rotvec", ("wx", "wy", "wz"), frozenset[str]()),
    ("rpy", ("roll", "pitch", "yaw"), frozenset[str]()),
)
"""Rotation format, names of its entries, and the words of which one must stand beside them (if any must)."""


def resolve(features: Features, config: ColumnsConfig) -> Columns:
    """Columns as configured, the others guessed.

    Raises:
        ValueError: a column that is not in the dataset, several candidates, no tool position and no joints given, a
            rotation whose format neither names nor configuration tell.
    """
    gripper = _gripper(features, config)
    ends = _gripper_range(features, gripper, config)
    if config.joints:
        return Columns(parse(features, config.joints, "joints"), True, None, "", gripper, ends)
    curve = parse(features, config.position, "position") if config.position else _position(features)
    if len(curve.indices) != 3:
        raise ValueError(f"columns.position is {curve}, {len(curve.indices)} entries; it must be x, y, z")
    rotation, rotation_format = _rotation(features, config, curve.feature)
    commanded = _commanded(features) if config.commanded and rotation else None
    opening = _opening(features, gripper, config)
    measured = _opening_range(features, opening, gripper, config)
    return Columns(curve, False, rotation, rotation_format, gripper, ends, commanded, opening, measured)


def _position(features: Features) -> Column:
    found = _by_axes(features, ("x", "y", "z"), without=_NOT_A_POSE | _ROTATION)
    found += _by_axes(features, ("px", "py", "pz"), without=_NOT_A_POSE)
    found = [column for column in found if column.feature != keys.ACTION]
    found += [
        Column(key, (0, 1, 2))
        for key, names in vectors(features).items()
        if not names
        and features[key]["shape"][0] >= 3
        and _tokens(key) & _TOOL
        and _tokens(key) & {"pos", "pose", "position"}
    ]
    found = _first_feature([column for column in found if _tokens(str(column)) & _TOOL] or found, keys.STATE)
    if not found:
        raise ValueError(
            f"no tool position found in {listing(features)}; give --columns.position=feature:start:stop, or follow the "
            "joint angles instead with --columns.joints=feature:start:stop (--epsilon then counts in radians)"
        )
    return _only(found, "position")


def _rotation(features: Features, config: ColumnsConfig, near: str) -> tuple[Column | None, str]:
    """Rotation column and its format; guesses come only from the feature ``near`` that holds the position."""
    if config.rotation == NONE:
        return None, ""
    if config.rotation:
        return _told_rotation(features, config.rotation, config.rotation_format)
    for rotation_format, axes, beside in _ROTATION_AXES:
        found = _by_axes({near: features[near]}, axes, beside, without=_NOT_A_POSE)
        if found:
            return _only(found, "rotation"), rotation_format
    return None, ""


def _told_rotation(features: Features, text: str, rotation_format: str | None) -> tuple[Column, str]:
    column = parse(features, text, "rotation")
    if rotation_format is None:
        named = _by_axes({column.feature: features[column.feature]}, ("qw", "qx", "qy", "qz"))
        ordered = next((one for one in named if set(one.indices) == set(column.indices)), None)
        if ordered is None:
            raise ValueError(
                f"columns.rotation is {column}; its names do not tell the order, so give --columns.rotation_format=... "
                f"({', '.join(ROTATION_FORMATS)})"
            )
        column, rotation_format = ordered, "wxyz"
    if len(column.indices) != ROTATION_FORMATS[rotation_format]:
        raise ValueError(
            f"columns.rotation is {column}, {len(column.indices)} entries; {rotation_format} has "
            f"{ROTATION_FORMATS[rotation_format]}"
        )
    return column, rotation_format


def _commanded(features: Features) -> tuple[Column, Column] | None:
    """Position and rotation in an action that bears our own pose names, and so is absolute and in w, x, y, z."""
    names = entry_names(features[keys.ACTION]) if keys.ACTION in features else ()
    if not set(keys.POSE_NAMES) <= set(names):
        return None
    position, rotation = (
        Column(keys.ACTION, tuple(names.index(name) for name in wanted), wanted)
        for wanted in (keys.POSITION_NAMES, keys.QUATERNION_NAMES)
    )
    return position, rotation


def _gripper(features: Features, config: ColumnsConfig) -> Column | None:
    if config.gripper == NONE:
        return None
    if config.gripper:
        return _entry(features, config.gripper, "gripper")
    found = _first_feature(_grippers(features), keys.ACTION)
    return _only(found, "gripper") if found else None


def _opening(features: Features, gripper: Column | None, config: ColumnsConfig) -> Column | None:
    """As told, else the gripper if that is measured, else the only other one that is."""
    if config.opening == NONE:
        return None
    if config.opening:
        return _entry(features, config.opening, "opening")
    if gripper and gripper.feature != keys.ACTION:
        return gripper
    found = _first_feature([column for column in _grippers(features) if column.feature != keys.ACTION], keys.STATE)
    return found[0] if len(found) == 1 else None


def _entry(features: Features, text: str, option: str) -> Column:
    column = parse(features, text, option)
    if len(column.indices) != 1:
        raise ValueError(f"columns.{option} is {column}, {len(column.indices)} entries; it must be one")
    return column


def _grippers(features: Features) -> list[Column]:
    found = []
    for key, names in sorted(vectors(features).items(), key=lambda item: item[0] != keys.STATE):
        if features[key]["shape"][0] == 1 and _tokens(key) & _GRIPPER:
            found.append(Column(key, (0,), names))
        else:
            found += [Column(key, (i,), (name,)) for i, name in enumerate(names) if _is_gripper(name)]
    return found


def _gripper_range(features: Features, gripper: Column | None, config: ColumnsConfig) -> tuple[float, float] | None:
    """Closed and open: as told; 0 and 1 where the gripper stands among our own pose names."""
    if config.gripper_range is not None:
        closed, opened = config.gripper_range
        return closed, opened
    if gripper and set(keys.POSE_NAMES) <= set(entry_names(features[gripper.feature])):
        return 0.0, 1.0
    return None


def _opening_range(
    features: Features, opening: Column | None, gripper: Column | None, config: ColumnsConfig
) -> tuple[float, float] | None:
    """Measured closed and open: as told; else as the gripper's where both are one, or bear our own names."""
    if config.opening_range is not None:
        closed, opened = config.opening_range
        return closed, opened
    ours = opening and set(keys.POSE_NAMES) <= set(entry_names(features[opening.feature]))
    return _gripper_range(features, opening, config) if ours or opening == gripper else None


def _is_gripper(name: str) -> bool:
    tokens = _tokens(name)
    return bool(tokens & _GRIPPER) and not tokens & (_NOT_A_POSE | _ROTATION | {"x", "y", "z"})


def _by_axes(
    features: Features, axes: tuple[str, ...], beside: Set[str] = frozenset(), without: Set[str] = frozenset()
) -> list[Column]:
    """Sets of entries whose names differ in nothing but the axis, e.g. tcp_x, tcp_y, tcp_z.

    Args:
        features: where to look.
        axes: the words that differ.
        beside: words of which one must stand in the rest of the name or in the feature's key; empty if none need to.
        without: words of which none may.
    """
    found = []
    for key, names in vectors(features).items():
        groups: dict[tuple[str, ...], dict[str, int]] = defaultdict(dict)
        for i, name in enumerate(names):
            tokens = re.split(r"[^a-z0-9]+", name.lower())
            for axis in set(tokens) & set(axes):
                groups[tuple("*" if token == axis else token for token in tokens)][axis] = i
        for group, entries in groups.items():
            words = {*group, *_tokens(key)}
            if set(entries) == set(axes) and not words & without and (not beside or words & beside):
                indices = tuple(entries[axis] for axis in axes)
                found.append(Column(key, indices, tuple(names[i] for i in indices)))
    return found


def _tokens(text: str) -> set[str]:
    return set(re.split(r"[^a-z0-9]+", text.lower()))


def _first_feature(found: list[Column], preferred: str) -> list[Column]:
    """Candidates of the ``preferred`` feature if it has any, else of the first feature that has."""
    features = [column.feature for column in found]
    first = preferred if preferred in features else next(iter(features), None)
    return [column for column in found if column.feature == first]


def _only(found: list[Column], option: str) -> Column:
    if len(found) > 1:
        raise ValueError(
            f"several columns may be the {option}: {' or '.join(map(str, found))}; choose with --columns.{option}=..."
        )
    return found[0]
