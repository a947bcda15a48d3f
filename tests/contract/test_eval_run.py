"""``histmv eval`` on a stand-in environment: results, resume, refusals, videos."""

import dataclasses
import json
import logging
import shutil
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from fake_ur5 import CAMERAS, FRAMES_PER_STEP, FakeUR5Config, write_checkpoint
from safetensors.numpy import load_file, save_file

from dataset_tools import overlay
from dataset_tools.cli import main
from dataset_tools.eval_checkpoint import PolicySource, load_config, load_policy
from dataset_tools.eval_film import HOLD_SECONDS
from dataset_tools.eval_results import INFO_FILE, Episode, read_episodes
from dataset_tools.eval_settings import EvaluateConfig, ScenesConfig
from dataset_tools.evaluate import EPISODES_FILE, Evaluation, run
from lerobot_histmv.envs.configuration_ur5 import UR5EnvConfig

SEEDS = range(200_000, 200_005)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("run") / "checkpoints" / "last" / "pretrained_model")


def settings(checkpoint: Path, output: Path, batch: int = 3, videos: int = 0, **env: Any) -> EvaluateConfig:
    return EvaluateConfig(
        env=FakeUR5Config(**env),
        policy=PolicySource(str(checkpoint)),
        eval=ScenesConfig(n_episodes=len(SEEDS), batch_size=batch),
        videos=videos,
        output_dir=output,
    )


def results(output: Path) -> list[Episode]:
    """Episodes in order of task and seed, without what differs from run to run."""
    episodes = {(one.task, one.seed): one for one in read_episodes(output / EPISODES_FILE)}
    return [dataclasses.replace(episodes[key], decision_ms=0.0, seconds=0.0, video="") for key in sorted(episodes)]


def assert_equal(first: list[Episode], second: list[Episode]) -> None:
    """Equal but for the float noise of batched matrix products in what depends on actions."""
    rough = {"sum_reward": 0.0, "max_reward": 0.0}
    assert [dataclasses.replace(one, **rough) for one in first] == [dataclasses.replace(one, **rough) for one in second]
    for name in rough:
        assert [getattr(one, name) for one in first] == pytest.approx([getattr(one, name) for one in second], abs=1e-4)


@pytest.fixture(scope="module")
def alone(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Episode]:
    """Every episode run by itself."""
    output = tmp_path_factory.mktemp("alone")
    run(settings(checkpoint, output, batch=1))
    return results(output)


def test_episodes_differ_and_end_at_different_times(alone: list[Episode]) -> None:
    assert [one.seed for one in alone] == list(SEEDS)
    assert len({one.steps for one in alone}) > 2 and {True, False} == {one.success for one in alone}
    assert len({round(one.sum_reward / one.steps, 6) for one in alone}) == len(alone), "the policy sees the scenes"


@pytest.mark.parametrize("batch", [2, 5])
def test_results_do_not_depend_on_the_batch(batch: int, checkpoint: Path, alone: list[Episode], tmp_path: Path) -> None:
    run(settings(checkpoint, tmp_path, batch))
    assert_equal(results(tmp_path), alone)


def test_interrupted_evaluation_goes_on_and_ends_the_same(
    checkpoint: Path, alone: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = Evaluation.run_task

    def stopped(*arguments: Any) -> Any:
        for count, episode in enumerate(append(*arguments)):
            if count == 3:
                raise KeyboardInterrupt
            yield episode

    monkeypatch.setattr(Evaluation, "run_task", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(settings(checkpoint, tmp_path))
    monkeypatch.undo()
    log = tmp_path / EPISODES_FILE
    log.write_bytes(log.read_bytes()[:-19])  # the last line was cut short
    kept = log.read_text().splitlines()[:-1]
    assert 0 < len(kept) < len(SEEDS) and not (tmp_path / INFO_FILE).exists()

    run(settings(checkpoint, tmp_path, batch=2))
    assert log.read_text().splitlines()[: len(kept)] == kept, "finished episodes are not run again"
    assert_equal(results(tmp_path), alone)


def test_finished_evaluation_only_reports_again(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(settings(checkpoint, tmp_path))
    info = json.loads((tmp_path / INFO_FILE).read_text())
    monkeypatch.setattr("dataset_tools.evaluate.Pilot.load", lambda *_: pytest.fail("the policy was loaded"))
    run(settings(checkpoint, tmp_path))
    assert json.loads((tmp_path / INFO_FILE).read_text()) == info


def test_info_names_tasks_seeds_and_settings(checkpoint: Path, tmp_path: Path) -> None:
    run(settings(checkpoint, tmp_path, task="fake_lift,fake_reach"))
    info = json.loads((tmp_path / INFO_FILE).read_text())
    assert [entry["task"] for entry in info["per_task"]] == ["fake_lift", "fake_reach"]
    assert info["overall"]["n_episodes"] == 2 * len(SEEDS)
    assert info["seeds"] == {"first": SEEDS[0], "last": SEEDS[-1]}
    failures = info["per_task"][0]["failures"]
    assert sum(failures.values()) + info["per_task"][0]["n_successes"] == len(SEEDS)
    assert failures.keys() <= {"wrong object", "grasp missed", "not reached"}
    assert info["settings"]["env"]["cameras"] == list(CAMERAS) and info["versions"]["lerobot"]
    assert info["env_type"] == "fake_ur5"


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_videos_show_every_tick_and_the_outcome_and_do_not_change_results(
    checkpoint: Path, alone: list[Episode], tmp_path: Path
) -> None:
    run(settings(checkpoint, tmp_path, videos=2))
    assert_equal(results(tmp_path), alone)
    videos = sorted((tmp_path / "videos" / "fake_lift").iterdir())
    assert [path.name for path in videos] == [f"{seed}.mp4" for seed in SEEDS[:2]]
    for path, episode in zip(videos, alone, strict=False):
        frames = decoded(path)
        assert len(frames) == 1 + FRAMES_PER_STEP * episode.steps + round(20 * HOLD_SECONDS)
        border = overlay.SUCCESS if episode.success else overlay.FAILURE
        assert np.abs(frames[-1][overlay.GAP + 1, 100].astype(int) - border).max() < 25
        assert np.abs(frames[0][overlay.GAP + 1, 100].astype(int) - border).max() > 25
    info = json.loads((tmp_path / INFO_FILE).read_text())
    assert info["overall"]["video_paths"] == [str(path) for path in videos]


def test_asking_for_videos_later_films_only_what_lacks_one(checkpoint: Path, tmp_path: Path) -> None:
    run(settings(checkpoint, tmp_path))
    before = results(tmp_path)
    run(settings(checkpoint, tmp_path, videos=2))
    assert_equal(results(tmp_path), before)
    assert len(read_episodes(tmp_path / EPISODES_FILE)) == len(SEEDS) + 2


def test_another_checkpoint_does_not_mix_with_what_the_folder_holds(checkpoint: Path, tmp_path: Path) -> None:
    output = tmp_path / "results"
    run(settings(checkpoint, output))
    written = (output / EPISODES_FILE).read_bytes()
    with pytest.raises(ValueError, match=r"something else \(differing: policy.weights_sha256\)"):
        run(settings(write_checkpoint(tmp_path / "other", seed=1), output))
    assert (output / EPISODES_FILE).read_bytes() == written


@pytest.mark.parametrize("cameras", [["front"], ["wrist", "front"], ["front", "wrist", "left_shoulder"]])
def test_other_cameras_are_refused_with_the_option_that_helps(
    cameras: list[str], checkpoint: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"set --env.cameras=\[front,wrist\]"):
        run(settings(checkpoint, tmp_path, cameras=cameras))


def test_images_of_another_size_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    config = settings(checkpoint, tmp_path)
    config.env = UR5EnvConfig(cameras=list(CAMERAS), image_size=64)
    with pytest.raises(ValueError, match=r"\(3, 32, 48\).*\(3, 64, 64\).*--env.image_size"):
        run(config)


@pytest.mark.parametrize(("control", "rate", "wanted"), [("servo", 0, 20), ("servo", 30, 20), ("macro", 20, 0)])
def test_ticks_of_policy_and_environment_must_fit(
    control: str, rate: int, wanted: int, checkpoint: Path, tmp_path: Path
) -> None:
    config = settings(checkpoint, tmp_path)
    config.env = UR5EnvConfig(cameras=list(CAMERAS), control=control)
    config.policy.overrides.append(f"--control.rate={rate}")
    with pytest.raises(ValueError, match=rf"--policy\.control\.rate={wanted} "):
        run(config)


def test_checkpoint_of_another_network_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    source = PolicySource(str(checkpoint), ["--network.width=16"])
    with pytest.raises(ValueError, match="another configuration"):
        load_policy(load_config(source))
    damaged = shutil.copytree(checkpoint, tmp_path / "damaged")
    weights = load_file(damaged / "model.safetensors")
    weights.pop(next(iter(weights)))
    save_file(weights, damaged / "model.safetensors")
    with pytest.raises(ValueError, match="another configuration"):
        load_policy(load_config(PolicySource(str(damaged))))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("", "name the checkpoint: --policy.path="),
        ("outputs/train/nothing/here", "there is no folder outputs/train/nothing/here"),
        ("{run}", r"did you mean --policy.path={run}/checkpoints/last/pretrained_model"),
    ],
)
def test_missing_checkpoints_are_named(path: str, message: str, checkpoint: Path) -> None:
    run_folder = str(checkpoint.parents[2])
    with pytest.raises(ValueError, match=message.format(run=run_folder)):
        load_config(PolicySource(path.format(run=run_folder)))


def test_unseen_instruction_is_followed_with_one_warning(
    checkpoint: Path, alone: list[Episode], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = shutil.copytree(checkpoint, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    config["instructions"] = {"press the button": ["press the button"]}
    (other / "config.json").write_text(json.dumps(config))
    with caplog.at_level(logging.WARNING):
        run(settings(other, tmp_path / "results"))
    warnings = [record.message for record in caplog.records if "not in the training data" in record.message]
    assert len(warnings) == 1 and "lift the fake cube" in warnings[0]
    assert_equal(results(tmp_path / "results"), alone)


@pytest.mark.parametrize("option", ["eval.n_episodes=0", "eval.batch_size=-1", "videos=-1", "seed=-5"])
def test_impossible_numbers_are_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    name, _, value = option.partition("=")
    with pytest.raises(SystemExit):
        main(["eval", "--env.type=fake_ur5", f"--{option}"])
    assert f"{name}={value} must be at least" in capsys.readouterr().err


def test_parallel_tasks_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["eval", "--env.type=ur5", "--env.max_parallel_tasks=2"])
    assert "env.max_parallel_tasks is 2; it must be 1" in capsys.readouterr().err


def test_command_line_reads_the_policy_as_lerobot_eval_does(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [f"--policy.path={checkpoint}", "--policy.device", "cpu", "--env.type=fake_ur5", "--eval.n_episodes=2"]
    main(["eval", *flags, "--videos=0", "--seed=200003", f"--output_dir={tmp_path}"])
    assert [one.seed for one in results(tmp_path)] == [200_003, 200_004]
    shown = capsys.readouterr()
    assert "fake_lift" in shown.out and "of 2" in shown.out and "Loading weights" not in shown.out + shown.err


def test_help_teaches_the_options(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["pytest"])
    with pytest.raises(SystemExit):
        main(["eval", "--help", "--env.type=ur5"])
    shown = capsys.readouterr().out
    assert shown.startswith("usage: histmv eval ")
    for option in ("--policy.path", "--env.task", "--eval.n_episodes", "--seed", "--videos", "--output_dir"):
        assert option in shown
