"""The card of a trained policy: what it was trained on, what it expects and returns, and how to evaluate it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from huggingface_hub import EvalResult, ModelCard, ModelCardData
from huggingface_hub.constants import HUGGINGFACE_CO_URL_HOME

import lerobot_histmv
from lerobot_histmv import keys
from lerobot_histmv.calibration_text import calibration_table
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
* An action is the next key pose: tool position [m], quaternion w, x, y, z, gripper (1 open, 0 closed). The arm moves to
  it with the gripper as it is, then the gripper is driven, then the next observation is taken."""


def model_card(
    config: HistMVConfig,
    training: Any = None,
    dataset_meta: Any = None,
    license: str | None = None,
    tags: Sequence[str] | None = None,
    evaluation: Mapping[str, Any] | None = None,
) -> ModelCard:
    """Card of a policy.

    Args:
        config: the policy's.
        training: LeRobot's ``TrainPipelineConfig`` of its training, if it is known.
        dataset_meta: LeRobot's metadata of the training data, if they are at hand.
        license: the Hub's name of a licence.
        tags: beside ``PROJECT_TAGS``.
        evaluation: content of an ``eval_info.json`` of ``histmv eval``, if the policy was measured.
    """
    data = ModelCardData(
        model_name=config.repo_id or "HistMV policy",
        eval_results=_eval_results(evaluation) if evaluation else None,
        license=license or config.license or LICENSE,
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys([*PROJECT_TAGS, *(tags or config.tags or [])])),
        datasets=[training.dataset.repo_id] if training else None,
    )
    parts = [f"# {config.repo_id or 'HistMV policy'}", _opening(config), "## Data and training"]
    parts.append(_training(config, training, dataset_meta))
    if dataset_meta is not None and keys.INTRINSICS in dataset_meta.features:
        parts.append(f"## Calibration of the training data\n\n{calibration_table(dataset_meta)}")
    parts += [f"## Conventions\n\n{CONVENTIONS}", _instructions(config)]
    parts.append(f"## Measured success\n\n{_measured(evaluation)}")
    parts += [_again(config, training), _evaluation(config)]
    text = "\n\n".join(parts)
    return ModelCard(f"---\n{data.to_yaml()}\n---\n\n{text}\n")


def _opening(config: HistMVConfig) -> str:
    rows, columns = config.image_size
    return (
        f"A history-sensitive multi-view keyframe policy (`histmv` {lerobot_histmv.__version__}): from colour, depth "
        f"and calibration of the cameras {', '.join(config.cameras)} ({columns} x {rows} pixels), an instruction and "
        f"{config.network.history.memory} past steps to the next key pose of the tool."
    )


def _training(config: HistMVConfig, training: Any, dataset_meta: Any) -> str:
    rows: dict[str, Any] = {}
    if training:
        name = training.dataset.repo_id
        rows["data"] = f"[{name}]({HUGGINGFACE_CO_URL_HOME}datasets/{name})"
    if dataset_meta is not None:
        rows["size"] = f"{dataset_meta.total_episodes} episodes of {dataset_meta.total_frames} rows"
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


def _eval_results(evaluation: Mapping[str, Any]) -> list[EvalResult]:
    """The successes as the Hub's front matter tells them."""
    return [
        EvalResult(
            task_type="robotics",
            task_name=task["task"],
            dataset_type=f"ur5/{task['task']}",
            dataset_name=f"{task['n_episodes']} unseen scenes of {task['task']}",
            metric_type="success_rate",
            metric_name="success [%]",
            metric_value=round(task["pc_success"], 1),
        )
        for task in evaluation["per_task"]
    ]


def _measured(evaluation: Mapping[str, Any] | None) -> str:
    if not evaluation:
        return "Not told here; the last command measures it."
    lines = ["| task | success | 95 % interval (Wilson) | failures |", "|---|---|---|---|"]
    for task in evaluation["per_task"]:
        low, high = task["wilson_95"]
        failures = ", ".join(f"{kind} {count}" for kind, count in task["failures"].items()) or "none"
        share = f"{task['n_successes']} of {task['n_episodes']}"
        lines.append(f"| `{task['task']}` | {share} | {low:.1f} to {high:.1f} % | {failures} |")
    seeds = evaluation["seeds"]
    return "\n".join([*lines, "", f"Scenes {seeds['first']} to {seeds['last']} of the environment `ur5`."])


def _again(config: HistMVConfig, training: Any) -> str:
    """How to train the same."""
    if not training:
        return "## Training it again\n\nNot told."
    path = config.repo_id or "USER/NAME"
    return (
        "## Training it again\n\nThe checkpoint holds the settings of its training:\n\n```bash\n"
        f"lerobot-train --config_path={path} --dataset.root=null --policy.push_to_hub=false "
        "--output_dir=outputs/again\n```"
    )


def _evaluation(config: HistMVConfig) -> str:
    path, cameras = config.repo_id or "USER/NAME", ",".join(config.cameras)
    env = f"--env.type=ur5 --env.task=TASK --env.cameras=[{cameras}] --env.image_size={config.image_size[0]}"
    return (
        "## Evaluation\n\nTo measure the success on unseen scenes, TASK being one of those that the data shows:\n\n"
        "```bash\n"
        "pip install 'lerobot_policy_histmv[sim]'\n"
        f"lerobot-eval --policy.path={path} {env} --eval.n_episodes=100\n"
        f"histmv eval --policy.path={path} {env} --eval.n_episodes=100  # with intervals and reasons of failures\n```"
    )
