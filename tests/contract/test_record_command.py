"""A recording gives the same bytes with any number of workers, through kills, crashes and errors."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import draccus
import pytest
from fake_demonstrations import CAMERAS, FAILING_SEEDS, recorder

from dataset_tools.hub import push, repositories
from dataset_tools.record import RecordConfig, Recorder, checked_settings, run
from dataset_tools.record_place import RECORDING_FILE
from dataset_tools.record_report import default_root
from dataset_tools.record_settings import RecordSettings
from dataset_tools.replay import read_scenes
from lerobot_histmv.envs.tasks.suites import SUITES

EPISODES = 7
SUCCESSES = [seed for seed in range(50) if seed not in FAILING_SEEDS][:EPISODES]


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("whole") / "data"
    recorder(root).record(EPISODES, workers=1)
    return root


def test_first_successes_are_kept_and_told(uninterrupted: Path) -> None:
    report = json.loads((uninterrupted / RECORDING_FILE).read_text())
    assert report["seeds"] == SUCCESSES
    assert [failure["seed"] for failure in report["failures"]] == list(FAILING_SEEDS)
    assert report["attempts"] == EPISODES + len(FAILING_SEEDS)
    assert report["success_rate"] == pytest.approx(EPISODES / report["attempts"])
    assert report["settings"]["cameras"] == list(CAMERAS)
    assert report["versions"]["lerobot"]
    assert read_scenes(uninterrupted / RECORDING_FILE, EPISODES).seeds == tuple(SUCCESSES)
    assert sorted(path.name for path in uninterrupted.parent.iterdir()) == ["data"]


def test_workers_do_not_change_a_byte(uninterrupted: Path, tmp_path: Path) -> None:
    recorder(tmp_path / "data").record(EPISODES, workers=2)
    assert contents(tmp_path / "data") == contents(uninterrupted)


def test_a_finished_recording_is_not_touched(uninterrupted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(uninterrupted)
    recorder(uninterrupted, crash_file=str(uninterrupted)).record(EPISODES - 2, workers=2)
    out = " ".join(capsys.readouterr().out.split())
    assert f"already recorded: pick_and_lift: {EPISODES} episodes" in out
    assert contents(uninterrupted) == before


def test_killed_at_any_moment_it_continues(uninterrupted: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    script = tmp_path / "script.py"
    script.write_text(
        "if __name__ == '__main__':\n"
        "    from fake_demonstrations import Path, recorder\n"
        f"    recorder(Path({str(root)!r}), seconds=0.4).record({EPISODES}, workers=2)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    process = subprocess.Popen([sys.executable, script], env=environment, stderr=subprocess.DEVNULL)
    parts = root.with_name("data.parts")
    deadline = time.monotonic() + 60
    while len(list(parts.glob("attempt-*.parquet"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    children = (Path("/proc") / str(process.pid) / "task" / str(process.pid) / "children").read_text().split()
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = len(list(parts.glob("attempt-*.parquet")))
    assert 2 <= finished < EPISODES
    assert not root.exists()
    assert_gone(children)
    recorder(root).record(EPISODES, workers=1)
    assert contents(root) == contents(uninterrupted)
    assert not parts.exists()


def assert_gone(processes: list[str]) -> None:
    """Workers notice that their parent is dead."""
    deadline = time.monotonic() + 10
    while any(is_running(process) for process in processes):
        assert time.monotonic() < deadline, "a worker outlived the recording"
        time.sleep(0.05)


def is_running(process: str) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_broken_attempts_are_reported_and_resumed(uninterrupted: Path, tmp_path: Path) -> None:
    crash, error = tmp_path / "crash", tmp_path / "error"
    recording = recorder(tmp_path / "data", crash_file=str(crash), error_file=str(error))
    crash.touch()
    with pytest.raises(ChildProcessError, match=r"a recording process died .*finished episodes are kept"):
        recording.record(EPISODES, workers=1)
    crash.rename(error)
    with pytest.raises(ChildProcessError, match=r"scene seed 0 broke off \(no graphics\)"):
        recording.record(EPISODES, workers=1)
    assert not (tmp_path / "data").exists()
    error.unlink()
    recording.record(EPISODES, workers=1)
    assert contents(tmp_path / "data") == contents(uninterrupted)


def test_permission_to_upload_is_asked_for_before_and_the_dataset_goes_up_after(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    done: list[str] = []
    monkeypatch.setattr(repositories, "prepare", lambda repo_id, private: done.append(f"prepare {repo_id} {private}"))
    monkeypatch.setattr(Recorder, "record", lambda *_: done.append("record"))
    monkeypatch.setattr(push, "push_dataset", lambda *arguments: done.append(f"push {arguments}"))
    words = ["--env.task=reach_target", "--repo_id=ann/dense", f"--root={tmp_path}/d", "--push_to_hub=true"]
    run(draccus.parse(RecordConfig, args=[*words, "--private=true", "--license=mit"]))
    assert done == ["prepare ann/dense True", "record", f"push {(tmp_path / 'd', 'ann/dense', True, 'mit')}"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env.task=make_coffee"], "task is 'make_coffee'; accepted are .*pick_and_lift.* suites set1"),
        ([], "task is ''; accepted are"),
        (["--env.task=turn_tap,turn_tap"], "names turn_tap more than once"),
        (["--env.task=turn_tap.up"], "variations of turn_tap are turn_tap.left, turn_tap.right"),
        (["--env.task=turn_tap.left", "--env.variation=1"], "give one of the two"),
        (["--env.task=turn_tap", "--episodes_per_variation=0"], "episodes_per_variation is 0"),
        (["--env.task=pick_and_lift", "--episodes=0"], "episodes is 0; it must be at least 1"),
        (["--env.task=pick_and_lift", "--workers=0"], "workers is 0"),
        (["--env.task=pick_and_lift", "--fps=15"], r"fps is 15; .* 20 Hz, so accepted are \[1, 2, 4, 5, 10, 20\]"),
        (["--env.task=pick_and_lift", "--seed=-1"], "seed is -1"),
        (["--env.task=pick_and_lift", "--seed=99999"], "exceed the 100000 recording seeds"),
        (["--env.task=pick_and_lift", "--env.type=pusht"], "only 'ur5' has scripted experts"),
        (["--env.task=pick_and_lift", "--env.variation=99"], "variation 99 of pick_and_lift does not exist"),
        (["--env.task=pick_and_lift", "--env.cameras=[front,ceiling]"], "cameras .*ceiling"),
        (["--env.task=pick_and_lift", "--env.image_size=1"], "image_size is 1"),
    ],
)
def test_impossible_settings_are_refused(tmp_path: Path, arguments: list[str], message: str) -> None:
    config = draccus.parse(RecordConfig, args=[*arguments, f"--root={tmp_path / 'data'}"])
    with pytest.raises(ValueError, match=message):
        run(config)
    assert list(tmp_path.iterdir()) == []


def test_flags_reach_the_settings() -> None:
    flags = ["--env.task=pick_and_lift", "--env.variation=2", "--env.cameras=[wrist,front]", "--env.image_size=64"]
    config = draccus.parse(RecordConfig, args=[*flags, "--fps=10", "--seed=11", "--overwrite=true"])
    assert checked_settings(config) == RecordSettings(("pick_and_lift",), 2, ("wrist", "front"), 64, 10, 11)
    assert config.overwrite


def test_suites_and_variations_become_tasks() -> None:
    def tasks(*flags: str) -> tuple[str, ...]:
        return checked_settings(draccus.parse(RecordConfig, args=list(flags))).tasks

    assert tasks("--env.task=turn_tap,reach_target") == ("turn_tap", "reach_target")
    split = ("turn_tap.left", "turn_tap.right", "open_door")
    assert tasks("--env.task=turn_tap,open_door", "--episodes_per_variation=3") == split
    assert tasks("--env.task=set1", "--episodes_per_variation=3") == SUITES["set1"]


@pytest.mark.parametrize("home", [None, "~/elsewhere"])
def test_default_root_is_lerobots(monkeypatch: pytest.MonkeyPatch, home: str | None) -> None:
    if home is None:
        from lerobot.utils.constants import HF_LEROBOT_HOME

        assert default_root("local/fake") == HF_LEROBOT_HOME / "local" / "fake"
    else:
        monkeypatch.setenv("HF_LEROBOT_HOME", home)
        assert default_root("local/fake") == Path.home() / "elsewhere" / "local" / "fake"
