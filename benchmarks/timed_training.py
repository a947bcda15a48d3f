"""``lerobot-train`` on a budget of wall-clock minutes: steps that fit, and checkpoints at given minutes.

A step is timed first, because learning rate schedules span the whole run. Then the planned steps are trained, with a
checkpoint at every asked minute. The clock counts reading data, computing and writing checkpoints; it does not count
the time until the first step, in which Python and the data loader start. Killed and called again, training goes on
from its last checkpoint, with the clock as it was there.
"""

import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import ceil, gcd
from pathlib import Path

from rich.console import Console

from dataset_tools.demo import last_checkpoint, resume_training
from dataset_tools.shards import write_json
from dataset_tools.stages import Command, run_stage

PLAN, CLOCK, STOPPED = "plan.json", "clock.json", "stopped"
SAVE_MINUTES = 5
"""At most so much training is lost when it is killed."""
PROBE_STEPS, PROBE_WARM_UP, PROBE_LEAST, PROBE_SECONDS = 10**6, 3, 5, 60.0
"""Steps that the probe pretends to train, steps before the timed ones, fewest timed ones, seconds of timing."""
OVERRUN = 1.1
"""Share of the budget after which a training that turned out slower than the probe is stopped."""


class EnoughError(Exception):
    """The command is stopped: it did what was wanted of it."""


@dataclass(frozen=True)
class Plan:
    """Steps for a budget.

    Args:
        minutes: when a checkpoint is wanted [whole minutes of training]; the last is the budget.
        seconds_per_step: measured.
        steps: to train.
        save_freq: steps between checkpoints; the step of every wanted minute is a multiple.
    """

    minutes: tuple[int, ...]
    seconds_per_step: float
    steps: int
    save_freq: int

    @classmethod
    def of(cls, minutes: Sequence[int], seconds_per_step: float) -> "Plan":
        """The plan for ``minutes`` (at least 1 each)."""
        distance = gcd(*minutes)
        saves = ceil(distance / SAVE_MINUTES)
        save_freq = max(1, round(60 * distance / saves / seconds_per_step))
        return cls(tuple(sorted(minutes)), seconds_per_step, save_freq * saves * max(minutes) // distance, save_freq)

    def wanted(self) -> list[int]:
        """Steps of the wanted checkpoints."""
        return [self.steps * minute // self.minutes[-1] for minute in self.minutes]

    def seconds(self) -> float:
        """Training time after which it is stopped [s]."""
        return 60 * OVERRUN * self.minutes[-1]


class Clock:
    """Seconds of training at each checkpoint, kept in a file; give ``tick`` the progress of ``lerobot-train``.

    Args:
        folder: where the file lies.
        plan: what is trained.
        first: step that training starts or goes on from; what was reached beyond it is lost.
        now: the time [s].
    """

    def __init__(self, folder: Path, plan: Plan, first: int, now: Callable[[], float] = time.monotonic) -> None:
        self._file, self._plan, self._first, self._now = folder / CLOCK, plan, first, now
        known = json.loads(self._file.read_text()) if self._file.is_file() else {}
        self.reached = {int(step): seconds for step, seconds in known.items() if int(step) <= first}
        self._before = self.reached.get(first, 0.0)
        self._start: float | None = None

    def tick(self, done: int, total: int) -> None:
        """Note the time if a checkpoint is due.

        Raises:
            EnoughError: the budget is used up.
        """
        if total != self._plan.steps - self._first or done == 0:
            return  # another progress bar, or the data loader's process is starting
        now = self._now()
        if self._start is None:
            self._start = now - done * self._plan.seconds_per_step
        seconds = self._before + now - self._start
        step = self._first + done
        due = step - step % self._plan.save_freq
        if due > self._first and due not in self.reached:
            self.reached[due] = seconds
            write_json(self._file, {str(step): seconds for step, seconds in self.reached.items()})
        if seconds > self._plan.seconds() and step < self._plan.steps:
            raise EnoughError


class Probe:
    """Times the steps of a training that is not wanted for itself; give ``tick`` its progress."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._first: tuple[int, float] | None = None
        self.seconds_per_step = 0.0

    def tick(self, done: int, total: int) -> None:
        """Note the time.

        Raises:
            EnoughError: enough steps were timed.
        """
        if total != PROBE_STEPS or done < PROBE_WARM_UP:
            return
        now = self._now()
        self._first = self._first or (done, now)
        steps, seconds = done - self._first[0], now - self._first[1]
        if steps >= PROBE_LEAST and seconds >= PROBE_SECONDS:
            self.seconds_per_step = seconds / steps
            raise EnoughError


def checkpoint(training: Path, step: int) -> Path:
    """Folder of LeRobot's checkpoint at ``step``."""
    return training / "checkpoints" / f"{step:06d}"


def newest_step(training: Path) -> int:
    """Step of the newest complete checkpoint; 0 if there is none."""
    model = last_checkpoint(training)
    return int(model.parent.resolve().name) if model.exists() else 0


class TimedTraining:
    """A training in ``folder``, whose subfolder ``train`` is LeRobot's output folder.

    Args:
        command: ``lerobot-train`` with everything but steps, saving and output folder.
        folder: made if missing.
        minutes: when a checkpoint is wanted [whole minutes of training]; the last is the budget.
        console: shows progress.
        environment: variables for the command.
    """

    def __init__(
        self, command: Command, folder: Path, minutes: Sequence[int], console: Console, environment: Mapping[str, str]
    ) -> None:
        self.folder, self.training = folder, folder / "train"
        self._command, self._console, self._environment = command, console, environment
        (folder / "logs").mkdir(parents=True, exist_ok=True)
        self.plan = self._plan(tuple(sorted(minutes)))

    @property
    def command(self) -> Command:
        """The training as one would type it."""
        plan = self.plan
        options = (f"--steps={plan.steps}", f"--save_freq={plan.save_freq}", f"--output_dir={self.training}")
        return (*self._command, *options)

    def run(self) -> dict[int, float]:
        """Train, or go on; step and training time [s] of the wanted checkpoints that were reached.

        Raises:
            StageFailedError: the training failed.
        """
        first = newest_step(self.training)
        clock = Clock(self.folder, self.plan, first)

        def watch(done: int, total: int) -> None:
            clock.tick(done, total)
            self._forget_older(newest_step(self.training))

        if first < self.plan.steps and not (self.folder / STOPPED).exists():
            command = resume_training(self.command, self.training)()
            if not self._follow(f"train {self.plan.steps} steps", command, watch):
                (self.folder / STOPPED).touch()
        newest = newest_step(self.training)
        return {step: clock.reached[step] for step in self.plan.wanted() if step <= newest}

    def _plan(self, minutes: tuple[int, ...]) -> Plan:
        """The plan of this folder; a new one is made by training for a minute.

        Raises:
            ValueError: the folder's plan is for other minutes.
        """
        file, probe = self.folder / PLAN, Probe()
        if not file.is_file():
            output = self.folder / "probe"
            shutil.rmtree(output, ignore_errors=True)
            options = (f"--steps={PROBE_STEPS}", "--save_checkpoint=false", f"--output_dir={output}")
            self._follow("time a training step", (*self._command, *options), probe.tick)
            write_json(file, asdict(Plan.of(minutes, probe.seconds_per_step)))
        known = json.loads(file.read_text())
        if tuple(known["minutes"]) != minutes:
            raise ValueError(f"{self.folder} holds a training for the minutes {known['minutes']}, not {list(minutes)}")
        return Plan(**known | {"minutes": minutes})

    def _follow(self, title: str, command: Command, tick: Callable[[int, int], None]) -> bool:
        """Run ``command`` to its end (True) or until ``tick`` says that it is enough (False)."""
        log = self.folder / "logs" / f"{title.split()[0]}.log"
        try:
            run_stage(title, command, log, self._console, self._environment, tick)
        except EnoughError:
            return False
        return True

    def _forget_older(self, newest: int) -> None:
        """Delete what neither evaluation nor resuming needs: unwanted checkpoints, old states of the optimizer."""
        wanted = self.plan.wanted()
        for folder in (self.training / "checkpoints").glob("[0-9]*"):
            if int(folder.name) < newest:
                unneeded = folder / "training_state" if int(folder.name) in wanted else folder
                shutil.rmtree(unneeded, ignore_errors=True)
