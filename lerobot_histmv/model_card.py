"""The card of a trained policy: what it was trained on, what it expects and returns, and how to evaluate it."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard, ModelCardData
from huggingface_hub.constants import HUGGINGFACE_CO_URL_HOME

import lerobot_histmv
from lerobot_histmv import evaluation_text, keys
from lerobot_histmv.calibration_text import calibration_table
from lerobot_histmv.command_text import INSTALL, KEYFRAMES, TRAINING, command
from lerobot_histmv.configuration_histmv import HistMVConfig

LICENSE = "apache-2.0"
PROJECT_TAGS = ("robotics", "lerobot", "histmv", "keyframes", "rgb-d")
INSTRUCTIONS = 10
"""So many are printed; a policy may know hundreds."""

CONVENTIONS = """* World = robot base, metres, z up. Camera frame: x right, y down, z forward. Pixel (u, v)
  has its centre at (u, v).
* Calibration comes with every observation: `observation.camera_intrinsics` (fx, fy, cx, cy [pixels] of every camera)
  and `observation.camera_extrinsics` (rows of the 3 x 4 matrix from camera to world), in the cameras' order above.
* Depth in millimetres along the optical axis, 0 = invalid.
* `observation.state` begins with the measured tool: position [m], quaternion w, x, y, z (unit, w >= 0), opening of the
  gripper (1 open, 0 closed). The tool is the point between the finger pads.
* An action is the next key pose: tool position [m], quaternion w, x, y, z, gripper (1 open, 0 closed). The arm moves to
  it with the gripper as it is, then the gripper is driven, then the next observation is taken."""


def model_card(
    config: HistMVConfig,
    training: Any = None,
    dataset_meta: Any = None,
    license: str | None = None,
    tags: Sequence[str] | None = None,
    evaluation: evaluation_text.Evaluation | None = None,
    made: Sequence[str] = (),
    folder: str = "",
) -> ModelCard:
    """Card of a policy.

    Args:
        config: the policy's.
        training: LeRobot's ``TrainPipelineConfig`` of its training, if it is known.
        dataset_meta: LeRobot's metadata of the training data, if they are at hand.
        license: the Hub's name of a licence.
        tags: beside ``PROJECT_TAGS``.
        evaluation: content of an ``eval_info.json`` of ``histmv eval``, if the policy was measured.
        made: commands that make the training data again, as ``KEYFRAMES``, if the data tell them.
        folder: name of the checkpoint's folder, if it is handed on as such: then neither it nor its data are taken to
            be on the Hub.
    """
    place = folder or config.repo_id or "USER/NAME"
    data = ModelCardData(
        model_name=config.repo_id or "HistMV policy",
        eval_results=evaluation_text.hub_results(evaluation, config) if evaluation else None,
        license=license or config.license or LICENSE,
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys([*PROJECT_TAGS, *(tags or config.tags or [])])),
        datasets=[training.dataset.repo_id] if training and not folder else None,
    )
    parts = [f"# {config.repo_id or 'HistMV policy'}", _opening(config), "## Data and training"]
    parts.append(_training(config, training, dataset_meta, linked=not folder))
    if dataset_meta is not None and keys.INTRINSICS in dataset_meta.features:
        parts.append(f"## Calibration of the training data\n\n{calibration_table(dataset_meta)}")
    success = evaluation_text.measured(evaluation, config) if evaluation else "Not told; the last command measures it."
    parts += [_conventions(config), _instructions(config), f"## Measured success\n\n{success}"]
    parts.append(f"## Training it again\n\n{_again(training, made, place, folder)}")
    parts.append(f"## Evaluation\n\n{_evaluation(config, evaluation, place)}")
    text = "\n\n".join(parts)
    return ModelCard(f"---\n{data.to_yaml()}\n---\n\n{text}\n")


def _opening(config: HistMVConfig) -> str:
    rows, columns = config.image_size
    return (
        f"A history-sensitive multi-view keyframe policy (`histmv` {lerobot_histmv.__version__}): from colour, depth "
        f"and calibration of the cameras {', '.join(config.cameras)} ({columns} x {rows} pixels), an instruction and "
        f"{config.network.history.memory} past steps to the next key pose of the tool."
    )


def _conventions(config: HistMVConfig) -> str:
    approach = tuple(config.loss.approach)
    points = f"\n* In its own frame the tool points along ({', '.join(f'{part:g}' for part in approach)})."
    return f"## Conventions\n\n{CONVENTIONS}{points if any(approach) else ''}"


def _training(config: HistMVConfig, training: Any, dataset_meta: Any, linked: bool) -> str:
    rows: dict[str, Any] = {}
    if training:
        name = training.dataset.repo_id
        rows["data"] = f"[{name}]({HUGGINGFACE_CO_URL_HOME}datasets/{name})" if linked else f"`{name}`"
    if dataset_meta is not None:
        rows["size"] = f"{dataset_meta.total_episodes} episodes, {dataset_meta.total_frames} rows in all"
        rows |= _keyframing(Path(dataset_meta.root) / keys.KEYFRAMING_FILE)
    if training:
        rows["steps"] = f"{training.steps}, batches of {training.batch_size}, seed {training.seed}"
        rows["learning rate"] = f"{config.optimizer_lr:g} (AdamW, warm-up and cosine)"
    lines = [f"| {name} | {value} |" for name, value in rows.items()]
    return "\n".join(["| | |", "|---|---|", *lines]) if lines else "Not told."


def _keyframing(path: Path) -> dict[str, str]:
    """How the data's key poses were chosen."""
    if not path.is_file():
        return {}
    told = json.loads(path.read_text(encoding="utf-8"))
    options, total, unit = told["options"], told["totals"], f"m{told['unit']}"
    return {
        "key poses of": told["source"],
        "chosen by": f"`{options['method']}`, epsilon {1000 * options['epsilon']:g} {unit}",
        "error": f"mean {1000 * total['error_mean']:.2f} {unit}, largest {1000 * total['error_max']:.1f} {unit}",
    }


def _instructions(config: HistMVConfig) -> str:
    known = list(config.instructions)
    listed = "\n".join(f"* {sentence}" for sentence in known[:INSTRUCTIONS])
    rest = f"\n* and {len(known) - INSTRUCTIONS} more" if len(known) > INSTRUCTIONS else ""
    return f"## Instructions\n\nTrained with {len(known)} instructions and their paraphrases:\n\n{listed}{rest}"


def _again(training: Any, made: Sequence[str], place: str, folder: str) -> str:
    """How to train the same, from nothing if that is known."""
    if not training:
        return "Not told."
    name = training.dataset.repo_id
    root: str | None = None
    if made:
        root, data = KEYFRAMES, f"the commands before it make the data, `{name}`"
    elif folder:
        root, data = "DATA", f"DATA is the folder of `{name}`"
    else:
        data = f"it reads `{name}` by this name, from LeRobot's own folder or the Hub"
    options: dict[str, Any] = {"config_path": place, "dataset.repo_id": name, "dataset.root": root}
    options |= {"steps": training.steps, "batch_size": training.batch_size, "seed": training.seed}
    # A checkpoint of a resumed training says of itself that it goes on, with its own weights, in its own folder.
    options |= {"resume": False, "policy.pretrained_path": None} if training.resume else {}
    options |= {"policy.push_to_hub": False, "output_dir": TRAINING}
    where = f" Run them where the folder `{folder}` lies." if folder else ""
    commands = "\n".join([INSTALL, *made, command("lerobot-train", options)])
    return (
        f"The checkpoint holds all settings of the last command; {data}.{where}\n\n```bash\n{commands}\n```\n\n"
        f"The result lies in `{TRAINING}/checkpoints/last/pretrained_model`."
    )


def _evaluation(config: HistMVConfig, evaluation: evaluation_text.Evaluation | None, place: str) -> str:
    aim = "the same scenes again" if evaluation else "unseen scenes, TASK being one of those that the data shows"
    commands = (
        evaluation_text.evaluation_command(config, evaluation, place, program)
        for program in ("lerobot-eval", "histmv eval")
    )
    return (
        f"To measure the success on {aim}: with LeRobot's command, or with one that adds intervals and reasons of "
        "failures.\n\n```bash\n" + "\n".join([INSTALL, *commands]) + "\n```"
    )
