"""What a dataset's card says: how it was made, measured errors, calibration, conventions, and the commands."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from huggingface_hub.constants import HUGGINGFACE_CO_URL_HOME
from lerobot.datasets import LeRobotDatasetMetadata

from dataset_tools.hub.card_commands import keyframe_command, record_command
from dataset_tools.record_place import RECORDING_FILE
from lerobot_histmv import keys
from lerobot_histmv.calibration_text import calibration_table
from lerobot_histmv.command_text import INSTALL

CONVENTIONS = """## Conventions

* World = robot base, metres, z up. Camera frame: x right, y down, z forward. The centre of pixel (u, v) is (u, v).
* `observation.camera_intrinsics`: fx, fy, cx, cy [pixels] of every camera; `observation.camera_extrinsics`: the rows of
  the 3 x 4 matrix that maps camera points to the world, per frame. Their order is in the features' names.
* Depth: uint16 millimetres along the optical axis, 0 = invalid.
* Quaternions: w, x, y, z, unit, w >= 0. Gripper: 1 open, 0 closed."""


def sections(root: Path, meta: LeRobotDatasetMetadata) -> list[str]:
    """Markdown sections of the card of the dataset in ``root``, title first."""
    recording, keyframing = (_read(root / name) for name in (RECORDING_FILE, keys.KEYFRAMING_FILE))
    found = [f"# {meta.repo_id}", _opening(meta, recording, keyframing)]
    if recording:
        found.append(_recording(recording))
    if keyframing:
        found.append(_keyframing(keyframing))
    if keys.INTRINSICS in meta.features and keys.EXTRINSICS in meta.features:
        found.append(f"## Calibration\n\n{calibration_table(meta)}")
        # Data of other origin may be calibrated and still order its quaternions otherwise.
        found += [CONVENTIONS] if tuple(meta.features[keys.ACTION]["names"] or ())[:8] == keys.POSE_NAMES else []
    found.append(_instructions(root, meta))
    return [*found, _use(meta, bool(keyframing)), *_commands(meta, recording, keyframing)]


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def table(rows: Mapping[str, Any]) -> str:
    """A Markdown table of names and values."""
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def _opening(meta: LeRobotDatasetMetadata, recording: Mapping[str, Any], keyframing: Mapping[str, Any]) -> str:
    rows = f"{meta.total_episodes} episodes, {meta.total_frames} rows in all"
    what = f"{rows}, in LeRobot's {meta.info.codebase_version} format"
    robot = f" Robot: {meta.robot_type}." if meta.robot_type else ""
    if keyframing:
        source = keyframing["source"]
        link = f"[{source}]({HUGGINGFACE_CO_URL_HOME}datasets/{source})"
        return f"Key poses of {link}: {what}, one row per macro step, with the next key pose as the action.{robot}"
    if recording:
        return f"Demonstrations of scripted experts on a simulated UR5e, {meta.fps} frames a second: {what}."
    return f"{what}, {meta.fps} frames a second.{robot}"


def _recording(told: Mapping[str, Any]) -> str:
    settings = told["settings"]
    disturbed = {name: value for name, value in settings["disturbances"].items() if value}
    rows = {
        "tasks": ", ".join(settings["tasks"]),
        "expert's success": f"{told['episodes']} of {told['attempts']} attempts, {100 * told['success_rate']:.1f} %; "
        "failed attempts are not in the data",
        "scene seeds": f"{min(told['seeds'])} to {max(told['seeds'])}",
        "images": f"{settings['image_size']} x {settings['image_size']}, cameras {', '.join(settings['cameras'])}",
        "disturbances": ", ".join(f"{name} {value:g}" for name, value in disturbed.items()) or "none",
        "versions": _versions(told),
    }
    return f"## Recording\n\n{table(rows)}"


def _versions(told: Mapping[str, Any]) -> str:
    return ", ".join(f"{package} {version}" for package, version in told["versions"].items() if version)


def _keyframing(told: Mapping[str, Any]) -> str:
    options, total, unit = told["options"], told["totals"], f"m{told['unit']}"
    gap = "not told: no episode has an optimum large enough to compare with"
    if total["median_gap"] is not None:
        gap = f"median {100 * total['median_gap']:.2f} % over {total['episodes_in_median_gap']} episodes"
    replayed = total["replayed"]
    rows = {
        "method": f"`{options['method']}`, distance to the {options['distance']}",
        "epsilon": f"{1000 * options['epsilon']:g} {unit}",
        "mean error": f"{1000 * total['error_mean']:.2f} {unit} per moving frame",
        "largest error": f"{1000 * total['error_max']:.1f} {unit}",
        "gap to the exact optimum": gap,
        "keyframes per episode": f"{total['keyframes_per_episode']:.1f} of {total['frames'] / total['episodes']:.0f}",
        "kept because of": ", ".join(f"{reason} {count}" for reason, count in total["reasons"].items()),
        "replay": f"the key poses succeed in {replayed - total['replay_failures']} of {replayed} episodes"
        if replayed
        else "not done",
        "columns": ", ".join(f"{name} = `{column}`" for name, column in told["columns"].items()),
        "versions": _versions(told),
    }
    notices = "".join(f"\n* {notice}" for notice in told["notices"])
    return f"## Keyframing\n\n{table(rows)}" + (f"\n\nNotes:\n{notices}" if notices else "")


def _instructions(root: Path, meta: LeRobotDatasetMetadata) -> str:
    paraphrases = _read(root / keys.INSTRUCTIONS_FILE)
    known = sorted({option for options in paraphrases.values() for option in options})
    said = [str(task) for task in meta.tasks.index]
    more = f" `{keys.INSTRUCTIONS_FILE}` lists {len(known)} wordings to draw from." if known else ""
    return f"## Instructions\n\n{len(said)} different ones, such as “{said[0]}”.{more}"


def _use(meta: LeRobotDatasetMetadata, keyframed: bool) -> str:
    load = f'```python\nfrom lerobot.datasets import LeRobotDataset\n\ndataset = LeRobotDataset("{meta.repo_id}")\n```'
    if keyframed:
        command = (
            "lerobot-train --config_path=$(histmv configs --name=train/default) "
            f"--dataset.repo_id={meta.repo_id} --output_dir=outputs/train"
        )
    else:
        command = f"histmv keyframe --dataset.repo_id={meta.repo_id} --output.repo_id={meta.repo_id}_keyframes"
    return f"## Use\n\n{load}\n\n```bash\n{INSTALL}\n{command}\n```"


def _commands(meta: LeRobotDatasetMetadata, recording: Mapping[str, Any], keyframing: Mapping[str, Any]) -> list[str]:
    made = [record_command(recording, meta.repo_id)] if recording else []
    made += [keyframe_command(keyframing, meta.repo_id)] if keyframing else []
    return [f"## Made with\n\n```bash\n{command}\n```" for command in made]
