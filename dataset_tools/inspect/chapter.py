"""What the page of inspected episodes says of each."""

import html
from collections import Counter
from collections.abc import Sequence

import numpy as np

from dataset_tools.figure_style import look
from dataset_tools.inspect.episodes import Episode, KeyPose
from dataset_tools.page import Chapter, Exhibit
from lerobot_histmv import keys


def chapter(episode: Episode, notes: Sequence[str], exhibits: Sequence[Exhibit]) -> Chapter:
    """What is to be said of ``episode``, whose pictures were written already."""
    name = f"episode {episode.number}"
    title = f"{name.capitalize()}: “{episode.instruction}”"
    return Chapter(name, title, facts(episode), notes, keyframe_table(episode), exhibits)


def facts(episode: Episode) -> str:
    """Length, keyframes and errors in one line."""
    counted = Counter(pose.reason for pose in episode.poses)
    why = ", ".join(f"{counted[reason]} {reason}" for reason in keys.REASONS if counted[reason])
    found = [f"{len(episode.poses)} keyframes ({why})"]
    if episode.motion:
        motion, unit = episode.motion, f"m{episode.unit}"
        frames, fps = len(motion.errors), motion.trajectory.fps
        found.insert(0, f"{frames} frames, {(frames - 1) / fps:.2f} s at {fps:g} Hz")
        mean, largest = 1000 * np.nanmean(motion.errors), 1000 * np.nanmax(motion.errors)
        found.append(f"error per moving frame: mean {mean:.2f} {unit}, largest {largest:.1f} {unit}")
        found.append(f"method {motion.options.method}, accepted {1000 * motion.options.epsilon:g} {unit}")
    return "; ".join(found)


def keyframe_table(episode: Episode) -> str:
    """The keyframes as an HTML table."""
    axes = [f"joint {index} [rad]" for index in range(len(episode.poses[0].position))]
    axes = axes if episode.is_joints else ["x [m]", "y [m]", "z [m]"]
    head = "".join(
        f"<th>{title}</th>" for title in ("", "kept for", "pose frame", "observation frame", *axes, "gripper")
    )
    rows = "".join(_row(number, pose) for number, pose in enumerate(episode.poses))
    return f"<table><tr>{head}</tr>{rows}</table>"


def _row(number: int, pose: KeyPose) -> str:
    style = look(pose.reason)
    reason = f'<span class="reason" style="background:{style.color}">{html.escape(pose.reason)}</span>'
    frames = (pose.frames.pose_frame, pose.frames.observation_frame) if pose.frames else ("?", "?")
    gripper = "" if pose.gripper is None else "open" if pose.gripper > 0.5 else "closed"
    cells = (number, reason, *frames, *(f"{value:.3f}" for value in pose.position), gripper)
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
