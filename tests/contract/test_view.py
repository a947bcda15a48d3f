"""``histmv view`` without a display: a video of the expert from every camera."""

from pathlib import Path

import av
import draccus
import pytest

pytest.importorskip("mujoco")

from dataset_tools.view import END_FRAMES, ViewConfig, run


def test_every_expert_is_filmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = ["reach_target.red", "turn_tap.left"]
    flags = [f"--env.task={','.join(tasks)}", "--env.image_size=32", "--window=false", "--seed=5"]
    run(draccus.parse(ViewConfig, args=[*flags, f"--output={tmp_path}"]))
    out = capsys.readouterr().out.replace("\n", "")
    for task in tasks:
        path = tmp_path / f"{task}_5.mp4"
        with av.open(str(path)) as video:
            frames = list(video.decode(video=0))
        assert len(frames) > END_FRAMES + 20
        assert (frames[0].width, frames[0].height) == (3 * 32, 32)
        assert f"{task}, scene 5" in out
        assert str(path) in out
    assert out.count("success") == len(tasks)


def test_bad_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="episodes is 0"):
        run(draccus.parse(ViewConfig, args=["--env.task=turn_tap", "--episodes=0"]))
    with pytest.raises(ValueError, match="seed is -3"):
        run(draccus.parse(ViewConfig, args=["--env.task=turn_tap", "--seed=-3"]))
    with pytest.raises(ValueError, match="accepted are reach_target"):
        run(draccus.parse(ViewConfig, args=["--env.task=juggle"]))
