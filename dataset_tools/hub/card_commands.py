"""The commands that make a dataset again, from what the dataset tells about itself."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dataset_tools.keyframes import KeyframeOptions
from dataset_tools.replay import SOURCE_RECORDING_FILE
from lerobot_histmv import keys
from lerobot_histmv.command_text import DEMONSTRATIONS, KEYFRAMES, command, flat


def data_commands(root: Path, repo_id: str) -> list[str]:
    """Commands that make the keyframed data in ``root`` again, as ``KEYFRAMES``; none if the data do not tell how.

    Demonstrations that ``histmv record`` did not make are read by their name.
    """
    keyframing, recording = (_read(root / name) for name in (keys.KEYFRAMING_FILE, SOURCE_RECORDING_FILE))
    if not keyframing:
        return []
    if not recording:
        return [keyframe_command(keyframing, repo_id, root=KEYFRAMES)]
    return [
        record_command(recording, keyframing["source"], DEMONSTRATIONS),
        keyframe_command(keyframing, repo_id, DEMONSTRATIONS, KEYFRAMES),
    ]


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def record_command(told: Mapping[str, Any], repo_id: str, root: str = "") -> str:
    """The ``histmv record`` command behind a ``meta/recording.json``, to the folder ``root`` if one is given."""
    settings = told["settings"]
    options = {
        "env.task": ",".join(settings["tasks"]),
        "episodes": told["episodes"] // len(settings["tasks"]),
        "seed": settings["seed"],
        "fps": settings["fps"],
        "env.cameras": settings["cameras"],
        "env.image_size": settings["image_size"],
    }
    if settings["variation"] is not None:
        options["env.variation"] = settings["variation"]
    options |= {f"env.disturbances.{name}": value for name, value in settings["disturbances"].items() if value}
    return command("histmv record", options | {"repo_id": repo_id} | _places(root=root))


def keyframe_command(told: Mapping[str, Any], repo_id: str, source_root: str = "", root: str = "") -> str:
    """The ``histmv keyframe`` command behind a ``meta/keyframing.json``: its columns, and what is not usual.

    Args:
        told: the file's content.
        repo_id: name of the keyframed dataset.
        source_root: folder of the dense one, if it is to be named.
        root: folder to write, if it is to be named.
    """
    usual = dict(flat(asdict(KeyframeOptions())))
    wanted = dict(flat(told["options"]))
    options = {"dataset.repo_id": told["source"], "output.repo_id": repo_id}
    options |= {name: wanted[name] for name in ("method", "epsilon", "seed")}
    options |= {name: value for name, value in wanted.items() if usual.get(name) != value}
    options |= _kept(told) | _episodes(told) | _columns(told["columns"])
    return command("histmv keyframe", options | _places(**{"dataset.root": source_root, "output.root": root}))


def _places(**folders: str) -> dict[str, str]:
    """Those options that name a folder."""
    return {option: folder for option, folder in folders.items() if folder}


def _kept(told: Mapping[str, Any]) -> dict[str, Any]:
    """Frames that were asked for, unless they are key poses for another reason too."""
    frames = {
        episode["source_episode"]: [frame["pose_frame"] for frame in episode["keyframes"] if frame["reason"] == "user"]
        for episode in told["episodes"]
    }
    asked = {number: found for number, found in frames.items() if found}
    return {"keep": asked} if asked else {}


def _episodes(told: Mapping[str, Any]) -> dict[str, Any]:
    """Which episodes were read, unless they are the first ones, and what replaying them was for."""
    kept = {episode["source_episode"] for episode in told["episodes"]}
    replayed = {int(number) for number in told["replay"]}
    read = sorted(kept | replayed)
    options: dict[str, Any] = {} if read == list(range(len(read))) else {"dataset.episodes": read}
    return options | ({"replay": "flag" if replayed <= kept else "drop"} if replayed else {})


def _columns(told: Mapping[str, str]) -> dict[str, Any]:
    options: dict[str, Any] = {"columns.rotation": "none", "columns.gripper": "none", "columns.commanded": False}
    for name, column in told.items():
        if turned := re.fullmatch(r"rotation \((\w+)\)", name):
            options |= {"columns.rotation": column, "columns.rotation_format": turned[1]}
        elif name.startswith("commanded"):
            options["columns.commanded"] = True
        else:
            options[f"columns.{name}"] = column
    return options
