"""A list of commands, run one after another: calm progress, a log each, and a state file from which it continues."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dataset_tools import child_process
from dataset_tools.locks import only_one

STATE_FILE = "stages.json"
LOG_FOLDER = "logs"
TAIL = 15

Command = tuple[str, ...]


@dataclass(frozen=True)
class Stage:
    """One command of a run.

    Args:
        name: names the stage's log and state.
        title: what the user reads while it runs.
        command: console script and arguments; also the key under which its result is known.
        resume: the command that continues an unfinished attempt; by default the command itself.
    """

    name: str
    title: str
    command: Command
    resume: Callable[[], Command] | None = None


@dataclass(frozen=True)
class Record:
    """What the state file knows of a stage that was begun."""

    command: list[str]
    finished: bool
    seconds: float


class StageFailedError(ChildProcessError):
    """A stage's command did not exit with 0."""


def read_state(folder: Path) -> dict[str, Record]:
    """Stages begun in ``folder``, by name."""
    path = folder / STATE_FILE
    if not path.exists():
        return {}
    return {name: Record(**record) for name, record in json.loads(path.read_text()).items()}


def write_state(folder: Path, state: Mapping[str, Record]) -> None:
    """Replace the state file in one step."""
    temporary = folder / f"{STATE_FILE}.tmp"
    temporary.write_text(json.dumps({name: asdict(record) for name, record in state.items()}, indent=2))
    temporary.replace(folder / STATE_FILE)


def check_commands(stages: Sequence[Stage], state: Mapping[str, Record], folder: Path) -> None:
    """Raise ValueError if ``folder`` holds stages that other commands made: nothing is mixed or overwritten."""
    for stage in stages:
        known = state.get(stage.name)
        if known is not None and known.command != list(stage.command):
            raise ValueError(
                f"{folder} holds a run whose stage {stage.name!r} had other settings:\n"
                f"  then: {' '.join(known.command)}\n  now:  {' '.join(stage.command)}\n"
                "Choose another output folder, or remove this one"
            )


def run_stages(stages: Sequence[Stage], folder: Path, console: Console, environment: Mapping[str, str]) -> None:
    """Run every stage that ``folder`` does not already hold.

    Raises:
        ValueError: the folder is in use, or holds a run with other settings.
        StageFailedError: a command failed; the message ends with the last lines of its log.
    """
    (folder / LOG_FOLDER).mkdir(parents=True, exist_ok=True)
    with only_one(folder, f"another run is at work in {folder}"):
        state = read_state(folder)
        check_commands(stages, state, folder)
        for number, stage in enumerate(stages, 1):
            title = f"[{number}/{len(stages)}] {stage.title}"
            known = state.get(stage.name)
            if known is not None and known.finished:
                say(console, f"{title}: {duration(known.seconds)} (done before)")
                continue
            command = stage.resume() if known is not None and stage.resume else stage.command
            state[stage.name] = Record(list(stage.command), False, 0.0)
            write_state(folder, state)
            seconds = run_stage(title, command, folder / LOG_FOLDER / f"{stage.name}.log", console, environment)
            state[stage.name] = Record(list(stage.command), True, seconds)
            write_state(folder, state)


def run_stage(
    title: str,
    command: Command,
    log: Path,
    console: Console,
    environment: Mapping[str, str],
    watch: Callable[[int, int], None] = lambda done, total: None,
) -> float:
    """Run one command with a progress line; returns the seconds it took.

    Args:
        title: what the user reads.
        command: console script and arguments.
        log: gets the command's output.
        console: shows the progress.
        environment: variables added to this process's own.
        watch: told (done, total) each time the command's progress bar moves; what it raises stops the command.

    Raises:
        StageFailedError: the command failed; the message ends with the last lines of its log.
    """
    start = time.monotonic()
    if not console.is_terminal:
        say(console, f"{title} ...")
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    display = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    # The child is started before the progress display, whose thread must not be forked.
    with child_process.start(command, environment) as child, display as bar:
        task = bar.add_task(title, total=None)

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)
            watch(done, total)

        status = child.follow(log, report)
    if status != 0:
        tail = "\n".join(f"  | {line}" for line in log.read_text().splitlines()[-TAIL:])
        raise StageFailedError(
            f"stage {title} ended with status {status}:\n{tail}\nAll of its output: {log}\n"
            "The same command tries this stage again and keeps what is finished."
        )
    seconds = time.monotonic() - start
    say(console, f"{title}: {duration(seconds)}")
    return seconds


def say(console: Console, text: str) -> None:
    """Print ``text`` as it is: brackets are no markup, long lines are not cut."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def duration(seconds: float) -> str:
    """``3 min 20 s``, or ``8 s`` below a minute."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
