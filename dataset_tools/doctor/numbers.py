"""Checks of one episode's numbers, in the order in which one rests on another."""

import numpy as np
from jaxtyping import Float

from dataset_tools.columns import Columns, vectors
from dataset_tools.doctor import calibration as doctor_calibration
from dataset_tools.doctor import poses as doctor_poses
from dataset_tools.doctor import vectors as doctor_vectors
from dataset_tools.doctor.findings import Finding, Severity
from dataset_tools.doctor.layout import Layout
from dataset_tools.doctor.read import EpisodeRows
from dataset_tools.source import Source
from dataset_tools.trajectories import wxyz
from lerobot_histmv.geometry import canonical

PATIENCE = 0.5
"""Time in which a dense recording reaches a commanded pose [s]: arms lag behind."""


def unusable(source: Source, rows: EpisodeRows) -> list[Finding]:
    """What keeps an episode from being looked at further."""
    length = source.length(rows.episode)
    found = doctor_vectors.rows_not_whole(rows.frame_index, length, rows.episode)
    found = found or doctor_vectors.not_finite(rows.vectors, vectors(source.features), rows.episode)
    if length == 1 and not source.is_keyframed:
        found.append(Finding.of("one_frame_episode", "it has 1 frame", rows.episode))
    return found


def check_numbers(source: Source, layout: Layout, rows: EpisodeRows) -> list[Finding]:
    """Checks of the numbers of an episode that is whole."""
    episode, columns = rows.episode, layout.columns
    found = doctor_vectors.time_gaps(rows.timestamp, float(source.meta.fps), episode)
    found += instructions(source, rows)
    found += doctor_vectors.repeated_rows(rows.vectors, episode)
    found += doctor_vectors.gripper_range(rows.vectors, vectors(source.features), episode)
    calibration = check_calibration(layout, rows)
    if columns is not None and not columns.is_joints:
        if not source.is_keyframed:
            found += doctor_vectors.tool_jumps(columns.curve.of(rows.vectors), episode)
        moving = {} if calibration else moving_cameras(layout, rows)
        rotations = check_rotations(columns, rows, moving)
        if all(finding.severity != Severity.ERROR for finding in rotations):
            within = 1 if source.is_keyframed else max(1, round(PATIENCE * source.meta.fps))
            rotations += check_action(columns, rows, within)
        found += rotations
    return found + calibration


def instructions(source: Source, rows: EpisodeRows) -> list[Finding]:
    """Every row's task has a text."""
    for index in np.unique(rows.task_index).tolist():
        frame = int(np.argmax(rows.task_index == index))
        if not 0 <= index < len(source.meta.tasks):
            message = f"task_index {index} is not in meta/tasks.parquet"
            return [Finding.of("instructions_missing", message, rows.episode, frame)]
        if not source.task(index).strip():
            return [Finding.of("instructions_missing", f"task {index} has no text", rows.episode, frame)]
    return []


def check_calibration(layout: Layout, rows: EpisodeRows) -> list[Finding]:
    """Calibration of every camera; whether views hold the tool only if all of it is right."""
    episode, found = rows.episode, []
    tool = layout.position.of(rows.vectors) if layout.position else None
    for camera, column in layout.intrinsics.items():
        found += doctor_calibration.intrinsics_size(column.of(rows.vectors), layout.sizes[camera], camera, episode)
    for camera in layout.extrinsics:
        poses = rows.extrinsics(layout, camera)
        found += doctor_calibration.extrinsics_rotation(poses, camera, episode)
        if tool is not None:
            found += doctor_calibration.extrinsics_constant(poses, tool, camera, episode)
    calibrated = [camera for camera in layout.intrinsics if camera in layout.extrinsics]
    if tool is not None and calibrated == list(layout.sizes) and calibrated and not found:
        views = [
            (layout.intrinsics[camera].of(rows.vectors), rows.extrinsics(layout, camera), layout.sizes[camera])
            for camera in calibrated
        ]
        found += doctor_calibration.tool_outside(tool, views, episode)
    return found


def moving_cameras(layout: Layout, rows: EpisodeRows) -> dict[str, Float[np.ndarray, "n 3 3"]]:
    """Rotations of ``T_world_cam`` of cameras that move."""
    poses = {camera: rows.extrinsics(layout, camera) for camera in layout.extrinsics}
    return {camera: pose[..., :3] for camera, pose in poses.items() if not doctor_calibration.is_still(pose)}


def check_rotations(
    columns: Columns, rows: EpisodeRows, cameras: dict[str, Float[np.ndarray, "n 3 3"]]
) -> list[Finding]:
    """Norm, then order, then sign of quaternions in state and action."""
    told = [(columns.rotation, columns.rotation_format)] if columns.rotation else []
    told += [(columns.commanded[1], "wxyz")] if columns.commanded else []
    named = {str(column): wxyz(column.of(rows.vectors), order) for column, order in told if order in ("wxyz", "xyzw")}
    norms = [
        finding
        for name, values in named.items()
        for finding in doctor_poses.quaternion_norm(values, name, rows.episode)
    ]
    if norms:
        return norms
    measured = str(columns.rotation)
    orders = (
        doctor_poses.quaternion_order(named[measured], cameras, measured, rows.episode) if measured in named else []
    )
    return orders or [
        finding
        for name, values in named.items()
        for finding in doctor_poses.quaternion_sign(values, name, rows.episode)
    ]


def check_action(columns: Columns, rows: EpisodeRows, within: int) -> list[Finding]:
    """Whether commanded poses are reached, where the action's names tell that it is one."""
    if columns.commanded is None or columns.rotation is None:
        return []
    position, rotation = columns.commanded
    commanded = position.of(rows.vectors), canonical(rotation.of(rows.vectors))
    turned = canonical(wxyz(columns.rotation.of(rows.vectors), columns.rotation_format))
    return doctor_poses.action_not_reached(commanded, (columns.curve.of(rows.vectors), turned), within, rows.episode)
