"""The demo's stages fit together, training continues, and its page shows what was made."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from dataset_tools import demo, demo_figures, demo_report
from dataset_tools.eval_results import Episode, EpisodeLog
from dataset_tools.stages import Record, write_state
from lerobot_histmv import keys

CAMERAS = ("front", "wrist")
HEIGHT, WIDTH = 11, 13
REASONS = ["start", "ga", "gripper"]


def option(command: tuple[str, ...], name: str) -> str:
    """Value of ``--name=value`` in a command."""
    (value,) = [word.partition("=")[2] for word in command if word.startswith(f"--{name}=")]
    return value


def test_each_stage_reads_what_the_one_before_wrote() -> None:
    stages = {stage.name: stage.command for stage in demo.stages(demo.DemoConfig(output=Path("out"), scenes=7))}
    assert list(stages) == ["record", "keyframe", "train", "evaluate", "report"]
    assert option(stages["keyframe"], "dataset.root") == option(stages["record"], "root")
    assert option(stages["train"], "dataset.root") == option(stages["keyframe"], "output.root")
    assert option(stages["train"], "dataset.repo_id") == option(stages["keyframe"], "output.repo_id")
    assert option(stages["evaluate"], "policy.path").startswith(option(stages["train"], "output_dir"))
    assert option(stages["evaluate"], "eval.n_episodes") == "7"
    assert not any(word.startswith("--seed") for word in stages["evaluate"]), "unseen scenes are the default"
    assert int(option(stages["record"], "seed")) < 100_000


def test_training_continues_from_its_last_checkpoint_or_starts_anew(tmp_path: Path) -> None:
    resume = demo.resume_training(("lerobot-train", "--steps=7"), tmp_path / "train")
    (tmp_path / "train" / "checkpoints").mkdir(parents=True)
    assert resume() == ("lerobot-train", "--steps=7")
    assert not (tmp_path / "train").exists(), "LeRobot refuses to start in an existing folder"
    checkpoint = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    checkpoint.mkdir(parents=True)
    (checkpoint / "train_config.json").touch()
    assert resume() == ("lerobot-train", f"--config_path={checkpoint / 'train_config.json'}", "--resume=true")


def training_log(*events: str) -> list[str]:
    """What lerobot-train prints for ``events``: a start, a checkpoint ("c1200"), or a loss ("1.2K 0.5")."""
    lines = ["INFO ot_train.py:272 {'batch_size': 3,", " 'log_freq': 400,"]
    for event in events:
        if event == "start":
            lines.append("INFO Start offline training on a fixed dataset, with effective batch size: 3")
        elif event.startswith("c"):
            lines.append(f"INFO Checkpoint policy after step {event[1:]}")
        else:
            step, loss = event.split()
            lines.append(f"INFO step:{step} smpl:7K ep:2 epch:0.13 loss:{loss} grdn:1.618 lr:1.0e-03 updt_s:0.1")
    return lines


def test_loss_curve_has_exact_steps_although_lerobot_rounds_them() -> None:
    history = demo_figures.read_losses(training_log("start", "400 4.0", "800 3.0", "1K 2.0", "2K 1.5"))
    assert history.steps == [400, 800, 1200, 1600]
    assert history.losses == [4.0, 3.0, 2.0, 1.5]


def test_loss_curve_of_a_continued_run_is_joined_at_the_checkpoint() -> None:
    events = ["start", "400 4.0", "c600", "800 3.0", "1K 9.0", "start", "800 2.5", "1K 2.0", "c1200", "2K 1.5"]
    history = demo_figures.read_losses(training_log(*events))
    assert history.steps == [400, 800, 1200, 1600]
    assert history.losses == [4.0, 2.5, 2.0, 1.5]


def encoded(pixels: np.ndarray, kind: str) -> dict[str, Any]:
    """An image as LeRobot's parquet files hold it."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format=kind)
    return {"bytes": buffer.getvalue(), "path": None}


@pytest.fixture
def finished_demo(tmp_path: Path) -> Path:
    """A demo's folder, as its stages before the report leave it."""
    random = np.random.default_rng(0)
    root = tmp_path / demo.KEYFRAMES
    rows = []
    for episode in range(2):
        for step, reason in enumerate(REASONS):
            row: dict[str, Any] = {
                "episode_index": episode, "frame_index": step, "task_index": episode,
                keys.REASON: keys.REASONS.index(reason), keys.SOURCE_TIMESTAMP: 0.25 * step,
            }  # fmt: skip
            for camera in CAMERAS:
                colours = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
                depth = random.integers(0, 2000, (HEIGHT, WIDTH), dtype=np.uint16)
                row |= {keys.rgb_key(camera): encoded(colours, "PNG"), keys.depth_key(camera): encoded(depth, "TIFF")}
            rows.append(row)
    (root / "data" / "chunk-000").mkdir(parents=True)
    (root / "meta").mkdir()
    pq.write_table(pa.Table.from_pylist(rows[::-1]), root / "data" / "chunk-000" / "file-000.parquet")
    (root / "meta" / "info.json").write_text(json.dumps({"features": dict.fromkeys(rows[0])}))
    tasks = pd.DataFrame({"task_index": [0, 1]}, index=pd.Index(["lift <red>", "lift blue"], name="task"))
    tasks.to_parquet(root / "meta" / "tasks.parquet")
    overall = {"n_successes": 6, "n_episodes": 7, "pc_success": 100 * 6 / 7, "wilson_95": [48.7, 97.4]}
    (tmp_path / demo.EVALUATION / "videos").mkdir(parents=True)
    (tmp_path / demo.EVALUATION / "eval_info.json").write_text(json.dumps({"overall": overall}))
    log = EpisodeLog(tmp_path / demo.EVALUATION / "episodes.jsonl")
    measured = {"steps": 3, "sum_reward": 0.0, "max_reward": 0.0, "decision_ms": 17.0, "seconds": 1.0}
    asked = {"task": "pick_and_lift", "instruction": "lift <red>"}
    log.append(Episode(seed=200003, success=False, failure="ik", video="videos/200003.mp4", **asked, **measured))
    log.append(Episode(seed=200004, success=True, failure="", video="videos/200004.mp4", **asked, **measured))
    log.append(Episode(seed=200005, success=True, failure="", video="", **asked, **measured))
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "train.log").write_text("\n".join(training_log("start", "400 4.0", "800 3.0")))
    write_state(tmp_path, {"train": Record(["lerobot-train", "--steps=800"], True, 83.0)})
    return tmp_path


def test_rows_of_one_keyframed_episode_are_read_in_order(finished_demo: Path) -> None:
    frames = demo_figures.read_keyframes(finished_demo / demo.KEYFRAMES, episode=1)
    assert [frame.reason for frame in frames] == REASONS
    assert [frame.seconds for frame in frames] == [0.0, 0.25, 0.5]
    assert frames[0].instruction == "lift blue"
    colours, depth = frames[2].pictures["wrist"]
    assert colours.shape == (HEIGHT, WIDTH, 3)
    assert depth is not None
    assert depth.shape == (HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="no episode 2"):
        demo_figures.read_keyframes(finished_demo / demo.KEYFRAMES, episode=2)


def test_page_shows_success_videos_pictures_and_commands(finished_demo: Path) -> None:
    demo_report.run(demo_report.ReportConfig(folder=finished_demo))
    page = (finished_demo / demo.PAGE).read_text()
    assert "6 of 7 unseen scenes succeeded: 86 % (95 % interval 49 to 97 %)." in page
    assert page.count("<video") == 2
    assert 'src="evaluation/videos/200003.mp4"' in page
    assert "“lift &lt;red&gt;”: failed: ik (scene 200003)" in page
    assert "“lift &lt;red&gt;”: success (scene 200004)" in page
    assert "1 min 23 s" in page
    assert "lerobot-train --steps=800" in page
    for name in ("keyframes.png", "loss.png"):
        assert f'src="{name}"' in page
        assert np.asarray(Image.open(finished_demo / name)).std() > 5


def test_a_report_without_an_evaluation_names_what_is_missing(finished_demo: Path) -> None:
    (finished_demo / demo.EVALUATION / "eval_info.json").unlink()
    with pytest.raises(OSError, match=r"eval_info\.json"):
        demo_report.run(demo_report.ReportConfig(folder=finished_demo))
