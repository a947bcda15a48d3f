"""The command that makes a dataset again, from what the dataset tells about itself."""

import json
import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from dataset_tools.keyframes import KeyframeOptions


def record_command(told: Mapping[str, Any], repo_id: str) -> str:
    """The ``histmv record`` command behind a ``meta/recording.json``."""
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
    return _command("record", options | {"repo_id": repo_id})


def keyframe_command(told: Mapping[str, Any], repo_id: str) -> str:
    """The ``histmv keyframe`` command behind a ``meta/keyframing.json``: its columns, and what is not usual."""
    usual = dict(_flat(asdict(KeyframeOptions())))
    wanted = dict(_flat(told["options"]))
    options = {"dataset.repo_id": told["source"], "output.repo_id": repo_id}
    options |= {name: wanted[name] for name in ("method", "epsilon", "seed")}
    options |= {name: value for name, value in wanted.items() if usual.get(name) != value}
    return _command("keyframe", options | _kept(told) | _episodes(told) | _columns(told["columns"]))


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


def _flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _command(name: str, options: Mapping[str, Any]) -> str:
    words = [f"--{option}={value if isinstance(value, str) else _plain(value)}" for option, value in options.items()]
    return " \\\n  ".join([f"histmv {name}", *map(shlex.quote, words)])


def _plain(value: Any) -> str:
    """As draccus reads it: JSON, but text and keys without quotes."""
    return json.dumps(value, separators=(",", ": ")).replace('"', "")
