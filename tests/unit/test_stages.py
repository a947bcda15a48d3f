"""Stages run once each, in order; killed or failed they continue; what they print goes to logs and progress."""

import fcntl
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from dataset_tools import child_process
from dataset_tools.stages import Stage, StageFailedError, read_state, run_stage, run_stages


def note(name: str, path: Path) -> tuple[str, ...]:
    """A command that appends ``name`` to a file: it shows how often and in which order stages ran."""
    return ("python", "-c", f"print('this is {name}'); open({str(path)!r}, 'a').write('{name} ')")


def run(stages: list[Stage], folder: Path) -> str:
    """Run and return what the user would read."""
    out = StringIO()
    run_stages(stages, folder, Console(file=out, width=80), {})
    return out.getvalue()


def test_stages_run_once_in_order_with_a_log_each(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    stages = [Stage(name, f"do {name}", note(name, ran)) for name in ("one", "two", "three")]
    first = run(stages, tmp_path / "out")
    assert ran.read_text() == "one two three "
    assert (tmp_path / "out" / "logs" / "two.log").read_text() == "this is two\n"
    assert "[2/3] do two" in first
    assert "this is" not in first
    again = run(stages, tmp_path / "out")
    assert ran.read_text() == "one two three "
    assert again.count("done before") == 3


def test_a_failed_stage_shows_the_end_of_its_log_and_only_it_is_tried_again(tmp_path: Path) -> None:
    ran, fine = tmp_path / "ran", tmp_path / "fine"
    program = f"import os, sys; print('the reason'); sys.exit(0 if os.path.exists({str(fine)!r}) else 7)"
    stages = [
        Stage("one", "one", note("one", ran)),
        Stage("two", "two", ("python", "-c", program)),
        Stage("three", "three", note("three", ran)),
    ]
    with pytest.raises(StageFailedError, match="status 7") as failure:
        run(stages, tmp_path / "out")
    assert "  | the reason" in str(failure.value)
    assert str(tmp_path / "out" / "logs" / "two.log") in str(failure.value)
    fine.touch()
    run(stages, tmp_path / "out")
    assert ran.read_text() == "one three "


def test_results_of_other_settings_are_never_continued(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    run([Stage("one", "one", note("one", ran))], tmp_path / "out")
    with pytest.raises(ValueError, match="other settings") as refusal:
        run([Stage("one", "one", note("another", ran))], tmp_path / "out")
    assert "this is one" in str(refusal.value)
    assert "this is another" in str(refusal.value)
    assert ran.read_text() == "one "


def test_a_second_run_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    with (tmp_path / ".lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="another run"):
            run([Stage("one", "one", note("one", tmp_path / "ran"))], tmp_path)
    assert not (tmp_path / "ran").exists()


KILLED_RUN = """
import pathlib, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell start with Ctrl-C ignored
from rich.console import Console
from dataset_tools.stages import Stage, run_stages
folder = pathlib.Path(sys.argv[1])
append = "open({!r}, 'a').write({!r})".format
ran = str(folder / "ran")
sleep = "import os, time; open({!r}, 'w').write(str(os.getpid())); time.sleep(600)".format(str(folder / "child"))
stages = [
    Stage("one", "one", ("python", "-c", append(ran, "one "))),
    Stage("two", "two", ("python", "-c", sleep), resume=lambda: ("python", "-c", append(ran, "resumed "))),
]
run_stages(stages, folder / "out", Console(), {})
"""


def alive(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_until(condition: object, seconds: float = 20.0) -> None:
    """Poll ``condition`` until it is true."""
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


@pytest.mark.skipif(sys.platform != "linux", reason="a killed parent takes its child along on Linux only")
@pytest.mark.parametrize("killed_by", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_killed_run_leaves_nothing_at_work_and_continues(tmp_path: Path, killed_by: signal.Signals) -> None:
    command = [sys.executable, "-c", KILLED_RUN, str(tmp_path)]
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    child = tmp_path / "child"
    wait_until(lambda: child.exists() and child.read_text())
    first.send_signal(killed_by)
    assert first.wait(20) != 0
    wait_until(lambda: not alive(int(child.read_text())))
    assert not read_state(tmp_path / "out")["two"].finished
    subprocess.run(command, check=True, capture_output=True)
    assert (tmp_path / "ran").read_text() == "one resumed "
    assert read_state(tmp_path / "out")["two"].finished


TQDM = """
import sys, time
from tqdm import tqdm
for i in tqdm(range(11), mininterval=0, desc="Training"):
    if i == 5:
        print("INFO step:5 loss:0.125", file=sys.stderr)
"""
RICH = """
import time
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress
with Progress(MofNCompleteColumn(), auto_refresh=False) as progress:
    task = progress.add_task("", total=11)
    for i in range(11):
        progress.update(task, advance=1)
        progress.refresh()
print("the end")
"""


@pytest.mark.parametrize(
    ("program", "line", "told"),
    [(TQDM, "INFO step:5 loss:0.125", set(range(12))), (RICH, "the end", {9})],
    ids=["tqdm", "rich"],
)
def test_progress_bars_become_progress_and_do_not_fill_the_log(
    program: str, line: str, told: set[int], tmp_path: Path
) -> None:
    seen: list[tuple[int, int]] = []
    with child_process.start(("python", "-c", program), {}) as child:
        assert child.follow(tmp_path / "log", lambda done, total: seen.append((done, total))) == 0
    counts = [done for done, _ in seen]
    assert {total for _, total in seen} == {11}
    assert counts == sorted(counts)
    assert told <= set(counts), "also counts that a line of text or the end of the bar follows"
    log = (tmp_path / "log").read_text()
    assert line in log.splitlines()
    assert len(log.splitlines()) <= 3


def test_child_knows_the_added_environment_and_a_terminal(tmp_path: Path) -> None:
    program = "import os, sys; print(os.environ['HISTMV_TEST'], sys.stdout.isatty())"
    with child_process.start(("python", "-c", program), {"HISTMV_TEST": "13"}) as child:
        child.follow(tmp_path / "log", lambda done, total: None)
    assert (tmp_path / "log").read_text() == "13 True\n"


def test_a_command_that_is_not_installed_is_named() -> None:
    with pytest.raises(ValueError, match="'no-such-command' is neither installed"):  # noqa: SIM117
        with child_process.start(("no-such-command",), {}):
            pass


def test_a_watch_that_raises_stops_the_command(tmp_path: Path) -> None:
    def watch(done: int, total: int) -> None:
        if done == 3:
            raise InterruptedError(f"{done} of {total}")

    endless = "import time\nfrom tqdm import tqdm\nfor _ in tqdm(range(10**9), mininterval=0): time.sleep(0.001)"
    with pytest.raises(InterruptedError, match="3 of 1000000000"):
        run_stage("endless", ("python", "-c", endless), tmp_path / "log", Console(file=StringIO()), {}, watch)
