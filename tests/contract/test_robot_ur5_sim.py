"""The simulated UR5e: held decisions do what macro steps do, and ``lerobot-rollout`` drives it with a policy."""

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_ur5 import CAMERAS, write_checkpoint
from lerobot.envs import preprocess_observation
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.scripts import lerobot_rollout
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features
from tiny_policy import tiny_config
from tiny_ur5 import expert_actions, tiny

from lerobot_histmv import keys
from lerobot_histmv.control import ControlConfig, HeldStep
from lerobot_histmv.envs.interface import REACH_HIGH, REACH_LOW
from lerobot_histmv.envs.processor_ur5 import UR5DepthProcessorStep
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.processor_histmv import make_histmv_pre_post_processors
from lerobot_histmv.robots.config_ur5_sim import UR5SimConfig
from lerobot_histmv.robots.ur5_sim import UR5Sim

pytest.importorskip("mujoco")
SIDE = 32
CONTROL = ControlConfig(rate=20)


def config(**changes: Any) -> UR5SimConfig:
    return UR5SimConfig(**{"camera_names": list(CAMERAS), "image_size": SIDE, "task": "reach_target"} | changes)


@pytest.fixture(scope="module")
def robot() -> Iterator[UR5Sim]:
    with UR5Sim(config()) as connected:
        yield connected


def test_observations_are_what_the_features_say(robot: UR5Sim) -> None:
    seen = robot.get_observation()
    assert list(seen) == list(robot.observation_features)
    for name, feature in robot.observation_features.items():
        assert seen[name].shape == feature if isinstance(feature, tuple) else isinstance(seen[name], feature), name
    passed_on = [name for name, feature in robot.observation_features.items() if feature is float]
    assert all(name.endswith(".pos") for name in passed_on), "lerobot-rollout drops numbers of other names"
    assert list(robot.action_features) == list(keys.POSE_NAMES)


def test_the_policy_sees_the_same_through_lerobots_robot_as_through_its_environment(robot: UR5Sim) -> None:
    before, _ = make_histmv_pre_post_processors(tiny_config(list(CAMERAS)))
    features = hw_to_dataset_features(robot.observation_features, "observation")
    frame = build_dataset_frame(features, robot.get_observation(), prefix="observation")
    from_robot = before(prepare_observation_for_inference(frame, torch.device("cpu"), task="reach"))
    seen = {**robot.scene.observe()}
    seen["pixels"] = {camera: image[None] for camera, image in seen["pixels"].items()}
    batch = preprocess_observation({key: v[None] if isinstance(v, np.ndarray) else v for key, v in seen.items()})
    from_env = before(UR5DepthProcessorStep().observation(batch) | {"task": ["reach"]})
    observed = [key for key in from_env if key.startswith("observation.")]
    assert {keys.INTRINSICS, keys.EXTRINSICS, keys.depth_key("wrist")} < set(observed)
    for key in observed:
        torch.testing.assert_close(from_robot[key], from_env[key], atol=1e-6, rtol=0, msg=key)
    assert from_robot["task"] == from_env["task"]


def test_a_wrong_action_is_refused_and_an_unconnected_robot_says_so(robot: UR5Sim) -> None:
    action = dict.fromkeys(keys.POSE_NAMES, 0.3)
    with pytest.raises(ValueError, match="not finite"):
        robot.send_action(action | {"ee.y.pos": np.nan})
    with pytest.raises(ValueError, match=r"lacks \['gripper.pos'\]"):
        robot.send_action({name: value for name, value in action.items() if name != "gripper.pos"})
    with pytest.raises(ConnectionError, match="connect"):
        UR5Sim(config()).get_observation()


@pytest.mark.parametrize("task", ["pick_and_lift", "push_buttons", "turn_tap"])
def test_decisions_held_at_20_hz_do_what_macro_steps_do(task: str) -> None:
    """The scripted expert decides; the arm that is measured is the simulated one, with its lag and its gripper."""
    env = tiny(task, control="servo", cameras=("front",))
    for seed in (3, 5):
        seen, _ = env.reset(seed=seed)
        held = HeldStep(CONTROL, REACH_LOW, REACH_HIGH, seen["agent_pos"][:8].astype(np.float64))
        success = False
        for decision in expert_actions(env):
            output = held.begin(decision, seen["agent_pos"][:8].astype(np.float64))
            while output is not None:
                seen, _, terminated, truncated, _ = env.step(output)
                success |= terminated
                assert not truncated or success
                output = held.output(seen["agent_pos"][:8].astype(np.float64))
        assert success, f"{task}, scene {seed}"
    env.close()


def start_rollout(monkeypatch: pytest.MonkeyPatch, folder: Path, *options: str) -> None:
    """Make ``lerobot_rollout.main`` what the command line would run with an untrained policy."""
    checkpoint = write_checkpoint(folder / "checkpoint", size=(SIDE, SIDE))
    views = [f"--robot.image_size={SIDE}", f"--robot.camera_names=[{','.join(CAMERAS)}]"]
    scene = ["--robot.type=ur5_sim", "--robot.stop_when_done=true", *views]
    pace = ["--fps=1000", "--duration=120", "--return_to_initial_position=false"]
    words = ["lerobot-rollout", f"--policy.path={checkpoint}", *scene, *pace, *options]
    monkeypatch.setattr(sys, "argv", words)


def test_lerobot_rollout_drives_the_robot_until_the_task_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """LeRobot's own command, from its command line on; only the decision is the expert's."""
    robots, looks, waiting = [], [], []
    connect = UR5Sim.connect
    monkeypatch.setattr(UR5Sim, "connect", lambda self, calibrate=True: (connect(self), robots.append(self)))

    def decide(self: HistMVPolicy, batch: dict[str, Any], past: Any, rows: list[int]) -> torch.Tensor:
        if not waiting:
            waiting.append(expert_actions(robots[0].scene))
        looks.append(robots[0].scene.stage.controller.ticks)
        return torch.from_numpy(next(waiting[0]))[None]

    monkeypatch.setattr(HistMVPolicy, "_decide", decide)
    start_rollout(monkeypatch, tmp_path, "--robot.task=pick_and_lift", "--robot.seed=3", "--policy.control.rate=20")
    logging.getLogger(UR5Sim.__module__).addHandler(caplog.handler)  # LeRobot removes the handlers above it
    lerobot_rollout.main()
    logging.getLogger(UR5Sim.__module__).removeHandler(caplog.handler)
    assert "pick_and_lift, scene 3: success after" in caplog.messages[-1]
    assert not robots[0].is_connected
    assert min(np.diff(looks)) > 2, "a decision is held over many ticks"


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Filled with the actions that reach a robot."""
    actions: list[dict[str, Any]] = []
    send = UR5Sim.send_action
    monkeypatch.setattr(UR5Sim, "send_action", lambda self, action: actions.append(action) or send(self, action))
    return actions


@pytest.mark.parametrize("name", ["ee.y.pos", "elbow.pos", "wrist.tz.pos"])
def test_lerobot_rollout_sends_nothing_after_a_measurement_that_is_no_number(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sent: list[dict[str, Any]]
) -> None:
    observe, good = UR5Sim.get_observation, 5

    def spoilt(self: UR5Sim) -> dict[str, Any]:
        seen = observe(self)
        assert name in seen
        return seen | {name: np.nan} if len(sent) == good else seen

    monkeypatch.setattr(UR5Sim, "get_observation", spoilt)
    start_rollout(monkeypatch, tmp_path, "--robot.task=reach_target", "--policy.control.rate=20")
    with pytest.raises(ValueError, match="NaN or infinity"):
        lerobot_rollout.main()
    assert len(sent) == good


def test_lerobot_rollout_sends_nothing_with_a_policy_of_whole_macro_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sent: list[dict[str, Any]]
) -> None:
    start_rollout(monkeypatch, tmp_path, "--robot.task=reach_target")
    with pytest.raises(ValueError, match=r"policy\.control\.rate is 0.*--policy\.control\.rate=20 .*--fps=20"):
        lerobot_rollout.main()
    assert sent == []
