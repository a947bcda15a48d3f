"""``histmv push``: a dataset or a checkpoint on disk, with its card, to the Hugging Face Hub."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from huggingface_hub import RepoCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from rich.console import Console

from dataset_tools.build import default_root
from dataset_tools.eval_checkpoint import fingerprint
from dataset_tools.eval_results import INFO_FILE
from dataset_tools.hub import card, repositories
from dataset_tools.hub.card_commands import data_commands
from dataset_tools.source import check_files, missing_files
from lerobot_histmv import _plugin  # noqa: F401  (registers the policy)
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.model_card import model_card

WEIGHTS, CONFIG = "model.safetensors", "config.json"


@dataclass
class PushConfig:
    """Upload a dataset or a checkpoint, with a card that tells how it was made.

        histmv push --repo_id=me/demos --root=demos
        histmv push --repo_id=me/policy --root=outputs/train/checkpoints/last/pretrained_model --evaluation=outputs/eval

    What breaks off may be repeated: the same command sends only what has not arrived, and until it is done readers see
    what was there before. Needs an access token that may write: `hf auth login`, or the variable HF_TOKEN. In the card,
    README.md beside the data, text outside of the marked part stays as you write it.
    """

    # Name on the Hub: user/name.
    repo_id: str
    # Folder of the dataset or checkpoint; by default LeRobot's own place for a dataset of this name.
    root: Path | None = None
    # Make the repository private.
    private: bool = False
    # Results of `histmv eval` of this very checkpoint, to be told in its card: the folder of eval_info.json.
    evaluation: Path | None = None
    # Upload; false: only write the card, to look at it or to hand the folder on in another way; its commands then name
    # the checkpoint by its folder.
    upload: bool = True
    # Licence, as the Hub names it; by default what README.md says, else apache-2.0. A keyframed dataset stays under the
    # licence of its source: say so if that is another one.
    license: str | None = None


def run(config: PushConfig) -> None:
    """Write the card and upload.

    Raises:
        ValueError: the folder holds neither dataset nor checkpoint, or one that is not whole; the results are those of
            another checkpoint; or the Hub refuses.
    """
    root = (config.root or default_root(config.repo_id)).expanduser().resolve()
    if (root / "meta/info.json").is_file():
        if config.evaluation:
            raise ValueError(f"{root} is a dataset, but --evaluation={config.evaluation} belongs to a checkpoint")
        push_dataset(root, config.repo_id, config.private, config.license, config.upload)
    elif (root / CONFIG).is_file() and (root / WEIGHTS).is_file():
        push_checkpoint(root, config)
    else:
        raise ValueError(
            f"{root} is neither a LeRobot dataset (meta/info.json) nor a checkpoint ({CONFIG} and {WEIGHTS}); "
            "give --root=FOLDER"
        )


def push_dataset(root: Path, repo_id: str, private: bool, license: str | None, upload: bool = True) -> None:
    """Upload the dataset in ``root``, with its card, and say where it is; or only write the card.

    Raises:
        ValueError: it is not whole, or the Hub refuses.
    """
    check_files(root)
    if not any(root.glob("meta/episodes/*/*.parquet")) or not (root / "meta/tasks.parquet").is_file():
        raise ValueError(f"{root} lacks meta/episodes or meta/tasks.parquet; record or copy it again")
    meta = LeRobotDatasetMetadata(repo_id, root)
    if missing := missing_files(meta, range(meta.total_episodes)):
        raise ValueError(f"{root} lacks {', '.join(map(str, missing))}; copy the dataset again")
    written = card.dataset_card(root, meta, license)
    if not upload:
        _save(written, root)
        return
    url = repositories.prepare(repo_id, private)
    _save(written, root)
    repositories.upload_dataset(root, repo_id, meta.info.codebase_version)
    _say(f"{meta.total_episodes} episodes, {meta.total_frames} rows are at {url}")


def push_checkpoint(folder: Path, given: PushConfig) -> None:
    """Upload the checkpoint in ``folder``, with a card if it is of this project's policy; or only write the card.

    Raises:
        ValueError: it is damaged, the results are those of another checkpoint, a card of another kind of policy is
            wanted, or the Hub refuses.
    """
    config = PreTrainedConfig.from_pretrained(folder)
    if not isinstance(config, HistMVConfig) and (given.evaluation or not given.upload):
        raise ValueError(
            f"{folder} is a policy of type {config.type}; cards, and so --evaluation and --upload=false, are for histmv"
        )
    config.repo_id, config.pretrained_path = given.repo_id, folder
    results = measured(given.evaluation, config) if given.evaluation else None
    url = repositories.prepare(given.repo_id, given.private, "model") if given.upload else ""
    if isinstance(config, HistMVConfig):
        training = TrainPipelineConfig.from_pretrained(folder) if (folder / "train_config.json").is_file() else None
        data, on_disk = training_data(training), "" if given.upload else folder.name
        made = data_commands(data.root, data.repo_id) if data else []
        written = model_card(config, training, data, evaluation=results, made=made, folder=on_disk)
        _save(card.refreshed(written, folder / card.CARD_FILE, given.license), folder)
    if given.upload:
        repositories.upload_checkpoint(folder, given.repo_id)
        _say(f"the policy is at {url}; evaluate it with lerobot-eval --policy.path={given.repo_id}")


def measured(evaluation: Path, config: PreTrainedConfig) -> dict[str, Any]:
    """Results of an evaluation.

    Raises:
        ValueError: there are none, or they are those of other weights.
    """
    file = evaluation / INFO_FILE
    if not file.is_file():
        raise ValueError(f"--evaluation={evaluation} holds no {INFO_FILE}; give the --output_dir of a `histmv eval`")
    results = json.loads(file.read_text(encoding="utf-8"))
    found = results.get("settings", {}).get("policy", {}).get("weights_sha256")
    if found != fingerprint(config)["weights_sha256"]:
        raise ValueError(f"{file} tells the results of {results.get('checkpoint')}, whose weights are not those given")
    return results


def training_data(training: TrainPipelineConfig | None) -> LeRobotDatasetMetadata | None:
    """Metadata of the data that a policy was trained on, if they lie on this disk."""
    if training is None:
        return None
    told = training.dataset
    root = Path(told.root) if told.root else default_root(told.repo_id)
    return LeRobotDatasetMetadata(told.repo_id, root) if (root / "meta/info.json").is_file() else None


def _save(written: RepoCard, folder: Path) -> None:
    written.save(folder / card.CARD_FILE)
    _say(f"card: {folder / card.CARD_FILE}")


def _say(line: str) -> None:
    Console(highlight=False).print(line, soft_wrap=True)
