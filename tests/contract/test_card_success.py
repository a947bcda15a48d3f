"""Cards tell measured success: of this very checkpoint, and under which settings."""

import json
from pathlib import Path
from typing import Any

import pytest
from fake_ur5 import write_checkpoint
from helpers.cards import commands_in, pushed
from helpers.episodes import snapshot
from helpers.evaluations import TASKS, evaluated
from helpers.keyframed import SIZE as SQUARE
from lerobot.configs import PreTrainedConfig

from dataset_tools.eval_results import INFO_FILE
from dataset_tools.eval_settings import EvaluateConfig
from dataset_tools.evaluate import Evaluation
from lerobot_histmv.envs.disturbances import Disturbances
from lerobot_histmv.evaluation_text import in_words, unusual_options


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "policy", size=(SQUARE, SQUARE))


def test_policys_card_tells_measured_success_of_this_very_checkpoint(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = snapshot(checkpoint)
    other = write_checkpoint(tmp_path / "other", seed=1, size=(SQUARE, SQUARE))
    with pytest.raises(SystemExit):
        pushed(checkpoint, f"--evaluation={evaluated(tmp_path / 'wrong', other)}")
    assert "whose weights are not those given" in capsys.readouterr().err
    assert snapshot(checkpoint) == files
    found = pushed(checkpoint, f"--evaluation={evaluated(tmp_path / 'evaluation', checkpoint)}")
    assert "| `turn_tap.left` | 2 of 3 | 20.8 to 93.9 % | time 1 | usual |" in found.text
    assert "Scenes 200019 to 200021 of the environment `ur5`" in found.text
    assert [(one.task_name, one.dataset_name, one.metric_value) for one in found.data.eval_results] == [
        ("reach_target.red", "3 unseen scenes of reach_target.red", 66.7),
        ("turn_tap.left", "3 unseen scenes of turn_tap.left", 66.7),
    ]


UNUSUAL: dict[str, tuple[dict[str, Any], list[str]]] = {
    "held-out sentences": ({"instruction_split": "held_out"}, []),
    "control=servo; policy.control.rate=20": ({"control": "servo"}, ["--control.rate=20"]),
    "held-out sentences; disturbances: dead_camera=1, distractors=2, camera=wrist": (
        {
            "instruction_split": "held_out",
            "disturbances": Disturbances(dead_camera=1.0, distractors=2, camera="wrist"),
        },
        [],
    ),
}


@pytest.mark.parametrize("words", UNUSUAL)
def test_success_is_told_with_the_settings_it_was_measured_under(
    words: str, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, overrides = UNUSUAL[words]
    results = evaluated(tmp_path / "evaluation", checkpoint, overrides, **env)
    found = pushed(checkpoint, f"--evaluation={results}")
    assert found.text.count(f" | {words} |") == 2, "in every row"
    assert {one.dataset_config for one in found.data.eval_results} == {words}
    assert all(one.dataset_name.endswith(f"({words})") for one in found.data.eval_results)

    monkeypatch.chdir(tmp_path)
    commands = commands_in(found.text, "Evaluation")
    assert commands["histmv eval"] == commands["lerobot-eval"]
    again = Evaluation(EvaluateConfig.parse(commands["histmv eval"], "histmv eval"))
    first = json.loads((results / INFO_FILE).read_text())
    assert json.loads(json.dumps(again.settings["env"])) == first["settings"]["env"]
    assert json.loads(json.dumps(again.settings["policy"])) == first["settings"]["policy"]
    assert again.provenance()["seeds"] == first["seeds"]
    assert again.config.env.task == ",".join(TASKS)


def test_options_of_unknown_environments_are_all_told_and_paths_only_by_their_names(checkpoint: Path) -> None:
    config = PreTrainedConfig.from_pretrained(checkpoint)
    evaluation = {"env_type": "elsewhere", "settings": {"env": {"speed": 2.5, "scene": {"file": "/data/one/two.xml"}}}}
    found = unusual_options(evaluation, config)
    assert found == {"env.speed": 2.5, "env.scene.file": "two.xml"}
    assert in_words(found) == "speed=2.5; scene.file=two.xml"
