"""``histmv eval`` on the real environments, with an untrained policy: both kinds of vector environment, and a video."""

from pathlib import Path

import av
import pytest
from fake_ur5 import write_checkpoint

from dataset_tools.cli import main
from dataset_tools.eval_results import read_episodes
from dataset_tools.evaluate import EPISODES_FILE

pytest.importorskip("mujoco")
SIDE = 32


@pytest.fixture(scope="module")
def flags(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    checkpoint = write_checkpoint(tmp_path_factory.mktemp("checkpoint"), size=(SIDE, SIDE))
    cameras, image = "--env.cameras=[front,wrist]", f"--env.image_size={SIDE}"
    task = ["--env.type=ur5", "--env.task=reach_target", "--env.render_size=96", cameras, image]
    return ["eval", f"--policy.path={checkpoint}", *task, "--eval.n_episodes=2", "--eval.batch_size=2"]


def test_processes_and_videos_do_not_change_results(flags: list[str], tmp_path: Path) -> None:
    main([*flags, "--eval.use_async_envs=false", "--videos=1", f"--output_dir={tmp_path / 'here'}"])
    main([*flags, "--eval.use_async_envs=true", "--videos=0", f"--output_dir={tmp_path / 'processes'}"])
    here, there = (
        sorted(read_episodes(tmp_path / name / EPISODES_FILE), key=lambda one: one.seed)
        for name in ("here", "processes")
    )
    for first, second in zip(here, there, strict=True):
        assert (first.success, first.failure, first.steps, first.views, first.instruction, first.variation) == (
            second.success,
            second.failure,
            second.steps,
            second.views,
            second.instruction,
            second.variation,
        )
        assert first.success or first.failure in ("wrong object", "grasp missed", "not reached", "ik", "time")
    assert here[0].video and not here[1].video
    with av.open(str(tmp_path / "here" / here[0].video)) as container:
        frames = sum(1 for _ in container.decode(video=0))
    assert frames > 20 + 5 * here[0].steps, "every tick is shown, not only every step"
