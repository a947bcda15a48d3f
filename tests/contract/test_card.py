"""Cards state how data were made, so exactly that their commands make the same again; what people wrote stays."""

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
from fake_demonstrations import CAMERAS, FAILING_SEEDS, SIZE, recorder
from fake_ur5 import write_checkpoint
from helpers import scene
from helpers.cards import commands_in, pushed
from helpers.episodes import snapshot, write_picks
from helpers.keyframed import SIZE as SQUARE
from huggingface_hub import DatasetCard, ModelCard
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.act.configuration_act import ACTConfig
from tiny_policy import TASK, tiny_config, tiny_policy

from dataset_tools import cli
from dataset_tools.hub import card
from dataset_tools.hub.card_commands import record_command
from dataset_tools.record import RecordConfig, checked_settings
from dataset_tools.record_report import recording_report
from dataset_tools.record_settings import RecordSettings
from dataset_tools.replay import SOURCE_RECORDING_FILE
from dataset_tools.shards import Outcome
from lerobot_histmv import keys

KEYFRAMING = [
    "--method=exact",
    "--epsilon=0.003",
    "--pause.dwell=0.13",
    "--columns.commanded=false",
    "--keep={2: [5, 6]}",
]


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("card")
    dense = write_picks(folder / "dense", count=3)
    places = [f"--dataset.root={dense}", f"--output.root={folder / 'keys'}", "--dataset.episodes=[0,2]"]
    names = ["--dataset.repo_id=ann/dense", "--output.repo_id=ann/keys"]
    cli.main(["keyframe", *places, *names, *KEYFRAMING])
    return folder / "keys"


def written(root: Path, license: str | None = None) -> DatasetCard:
    return card.dataset_card(root, LeRobotDatasetMetadata("ann/keys", root), license)


def command_in(text: str, name: str) -> list[str]:
    """Words of the command under "Made with"."""
    _, _, made = text.partition("## Made with")
    words = shlex.split(made.split("```")[1].removeprefix("bash").replace("\\\n", " "))
    assert words[:2] == ["histmv", name]
    return words[2:]


def test_keyframed_card_states_method_errors_calibration_and_source(keyed: Path) -> None:
    found, told = written(keyed), json.loads((keyed / keys.KEYFRAMING_FILE).read_text())
    assert found.data["license"] == "apache-2.0"
    assert {"LeRobot", "histmv", "keyframes", "rgb-d", "camera-calibration"} <= set(found.data["tags"])
    assert found.data["task_categories"] == ["robotics"]
    assert found.data["configs"][0]["data_files"] == "data/*/*.parquet"
    for part in (
        "`exact`",
        "3 mm",
        f"{1000 * told['totals']['error_mean']:.2f} mm per moving frame",
        f"{1000 * told['totals']['error_max']:.1f} mm",
        "gap to the exact optimum",
        "datasets/ann/dense",
        "| front | 19 x 17 | 20.00, 21.00, 9.00, 8.00 | [[1.00000, 0.00000, 0.00000, 0.00000], [0.00000, 1.0",
        "Quaternions: w, x, y, z",
        'LeRobotDataset("ann/keys")',
        "--dataset.repo_id=ann/keys",
    ):
        assert part in found.text, part


def test_cards_tell_the_whole_pose_of_fixed_cameras_and_that_others_move(tmp_path: Path) -> None:
    """Numbers that ``histmv calibrate-attach`` would take for the same dataset without calibration."""
    meta = LeRobotDatasetMetadata("test/scene", scene.write_scene(tmp_path / "scene"))
    dataset = card.dataset_card(meta.root, meta, None).text
    policy = tiny_policy(tiny_config()).generate_model_card("test/scene", "histmv", "mit", [], None, meta).text
    for text in (dataset, policy):
        rows = [line.strip("| ").split(" | ") for line in text.splitlines()]
        told = {cells[0]: cells[-1] for cells in rows if cells[0] in scene.RIG.cameras}
        assert told.pop(scene.RIG.moving) == f"moves with the tool: `{keys.EXTRINSICS}` tells the pose in every frame"
        assert told.keys() == scene.STILL.keys()
        for camera, pose in scene.STILL.items():
            np.testing.assert_allclose(json.loads(told[camera]), pose, atol=0.6e-5)


def test_the_cards_command_makes_the_same_data_again(keyed: Path, tmp_path: Path) -> None:
    words = command_in(written(keyed).text, "keyframe")
    cli.main(["keyframe", *words, f"--dataset.root={keyed.parent / 'dense'}", f"--output.root={tmp_path / 'again'}"])
    again, first = snapshot(tmp_path / "again"), snapshot(keyed)
    assert [name for name in first if name.startswith("data/")]
    assert all(again[name] == content for name, content in first.items() if name.startswith("data/"))


def test_recordings_card_tells_the_success_and_its_command_has_the_same_settings(tmp_path: Path) -> None:
    recorder(tmp_path / "dense").record(5, workers=1)
    found = written(tmp_path / "dense")
    assert f"5 of {5 + len(FAILING_SEEDS)} attempts" in found.text
    assert f"{SIZE} x {SIZE}, cameras {', '.join(CAMERAS)}" in found.text
    assert "keyframes" not in found.data["tags"]
    words = command_in(found.text, "record")
    assert {"--episodes=5", "--env.cameras=[left,right]"} <= set(words)


@pytest.mark.parametrize(
    "options", [["--env.task=set1", "--env.disturbances.depth=0.5"], ["--env.task=turn_tap", "--fps=5", "--seed=7"]]
)
def test_record_command_has_the_settings_of_the_recording(options: list[str]) -> None:
    settings = checked_settings(draccus.parse(RecordConfig, args=[*options, "--env.cameras=[wrist,front]"]))
    kept = Outcome(0, 0, "", 0, "", [], "", 1)
    command = record_command(recording_report(settings, [kept] * 3 * len(settings.tasks)), "ann/dense")
    words = shlex.split(command.replace("\\\n", " "))[2:]
    again = draccus.parse(RecordConfig, args=words)
    assert checked_settings(again) == settings
    assert again.episodes == 3


def test_what_people_wrote_stays(keyed: Path) -> None:
    path = keyed / card.CARD_FILE
    path.write_text("---\nlicense: mit\ntags:\n- mine\n---\n\nBefore.\n")
    written(keyed).save(path)
    assert path.read_text().count(card.BEGIN) == 1
    path.write_text(path.read_text().replace("3 mm", "4 mm") + "\nAfter.\n")
    found = written(keyed)
    assert found.text.strip().startswith("Before.")
    assert found.text.strip().endswith("After.")
    assert "3 mm" in found.text
    assert "4 mm" not in found.text
    assert found.data["license"] == "mit"
    assert {"mine", "LeRobot"} <= set(found.data["tags"])
    assert written(keyed, "cc-by-4.0").data["license"] == "cc-by-4.0"
    path.unlink()


def trained(repo: str, root: Path | None = None, **changes: Any) -> TrainPipelineConfig:
    """Settings of a training on such a dataset."""
    dataset = DatasetConfig(repo, root=str(root) if root else None)
    policy = tiny_config(repo_id="ann/policy")
    return TrainPipelineConfig(dataset, policy=policy, steps=7, batch_size=3, seed=5, **changes)


def test_policys_card_tells_data_conventions_and_how_to_evaluate(keyed: Path) -> None:
    policy = tiny_policy(tiny_config(repo_id="ann/policy"))
    meta = LeRobotDatasetMetadata("ann/keys", keyed)
    found = policy.generate_model_card("ann/keys", "histmv", "mit", ["mine"], trained("ann/keys", keyed), meta)
    assert isinstance(found, ModelCard)
    assert found.data["license"] == "mit"
    assert found.data["datasets"] == ["ann/keys"]
    assert {"robotics", "lerobot", "histmv", "mine"} <= set(found.data["tags"])
    for part in (
        "key poses of | ann/dense",
        "`exact`, epsilon 3 mm",
        "datasets/ann/keys)",
        "7, batches of 3, seed 5",
        "48 x 32 pixels",
        "from camera to world",
        "`observation.state` begins with the measured tool: position [m], quaternion w, x, y, z",
        "In its own frame the tool points along (0, 0, -1).",
        f"* {TASK}",
        "## Calibration of the training data",
    ):
        assert part in found.text, part
    again = commands_in(found.text, "Training it again")["lerobot-train"]
    assert {"--config_path=ann/policy", "--dataset.repo_id=ann/keys", "--dataset.root=null"} <= set(again)
    measure = commands_in(found.text, "Evaluation")
    assert measure["histmv eval"] == measure["lerobot-eval"]
    assert measure["histmv eval"][:3] == ["--policy.path=ann/policy", "--env.type=ur5", "--env.task=TASK"]
    assert "--env.cameras=[front,wrist]" in measure["histmv eval"]


def recorded(root: Path, repo: str) -> RecordSettings:
    """As if ``histmv record`` had made the demonstrations of the keyframed data in ``root``."""
    options = ["--env.task=pick_and_lift", "--seed=11", "--env.disturbances.depth=0.5", f"--repo_id={repo}"]
    settings = checked_settings(draccus.parse(RecordConfig, args=options))
    report = recording_report(settings, [Outcome(0, 0, "", 0, "", [], "", 1)] * 3)
    (root / SOURCE_RECORDING_FILE).write_text(json.dumps(report))
    return settings


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "policy", size=(SQUARE, SQUARE))


def test_handed_on_checkpoints_card_makes_data_and_training_again(
    keyed: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = shutil.copytree(keyed, tmp_path / "data")
    settings = recorded(data, "ann/dense")
    training = trained("ann/keys", data, output_dir=tmp_path / "train", resume=True)
    training.policy.pretrained_path = checkpoint
    training.save_pretrained(checkpoint)
    found = pushed(checkpoint)
    assert str(tmp_path) not in (checkpoint / card.CARD_FILE).read_text()
    assert found.data.get("datasets") is None
    assert "huggingface.co" not in found.text
    commands = commands_in(found.text, "Training it again")
    assert list(commands)[1:] == ["histmv record", "histmv keyframe", "lerobot-train"]

    record = draccus.parse(RecordConfig, args=commands["histmv record"])
    assert (checked_settings(record), record.episodes, record.repo_id) == (settings, 3, "ann/dense")

    monkeypatch.chdir(tmp_path)
    assert record.root
    shutil.copytree(keyed.parent / "dense", record.root)
    cli.main(["keyframe", *commands["histmv keyframe"]])
    (config_path, *words) = commands["lerobot-train"]
    again = TrainPipelineConfig.from_pretrained(config_path.partition("=")[2], cli_args=words)
    made, first = snapshot(Path(str(again.dataset.root))), snapshot(keyed)
    assert all(made[name] == content for name, content in first.items() if name.startswith("data/"))
    assert (again.dataset.repo_id, again.steps, again.batch_size, again.seed) == ("ann/keys", 7, 3, 5)
    assert not again.resume, "the archive holds no optimizer to go on with"
    assert again.policy.pretrained_path is None, "it starts from nothing, not from what it led to"
    assert not again.output_dir.is_absolute() and not again.output_dir.exists()


def test_data_that_do_not_tell_how_they_were_made_are_left_to_the_reader(checkpoint: Path, tmp_path: Path) -> None:
    trained("ann/real", tmp_path / "gone").save_pretrained(checkpoint)
    found = pushed(checkpoint)
    commands = commands_in(found.text, "Training it again")
    assert list(commands)[1:] == ["lerobot-train"]
    assert {"--config_path=policy", "--dataset.root=DATA"} <= set(commands["lerobot-train"])
    assert "DATA is the folder of `ann/real`" in found.text
    assert str(tmp_path) not in found.text


@pytest.mark.parametrize("option", ["--upload=false", "--evaluation=results"])
def test_cards_of_other_policies_are_not_promised(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ACTConfig(device="cpu").save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(SystemExit):
        cli.main(["push", "--repo_id=ann/act", f"--root={tmp_path}", option])
    assert "is a policy of type act; cards" in capsys.readouterr().err
    assert not (tmp_path / card.CARD_FILE).exists()
