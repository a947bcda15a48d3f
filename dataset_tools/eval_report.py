"""How an evaluation is shown: progress, the final table, and what was evaluated with what."""

import platform
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from dataset_tools.eval_results import Episode, wilson_interval

PACKAGES = ("lerobot_policy_histmv", "lerobot", "torch", "gymnasium", "mujoco", "numpy")


def circumstances() -> dict[str, Any]:
    """The command, the machine and the versions of what it ran."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "machine": f"{platform.machine()}, {cpu_count()} cores",
        "versions": {package: _version(package) for package in PACKAGES},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def progress_bar(console: Console) -> Progress:
    """A bar per task; its tasks need the field ``rate``."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    return Progress(*columns, TimeRemainingColumn(), console=console)


def success_rate(episodes: Sequence[Episode]) -> str:
    """Success so far with its 95 % interval, for the progress bar."""
    successes = sum(episode.success for episode in episodes)
    low, high = wilson_interval(successes, len(episodes))
    return f"{100 * successes / max(1, len(episodes)):.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def results_table(info: dict[str, Any]) -> Table:
    """The final table of an ``eval_info.json``: one line per task, and one for all if there are several."""
    task = Column("task", no_wrap=True, min_width=max(len(entry["task"]) for entry in info["per_task"]))
    table = Table(task, "success", "rate", "95 % interval", "failures", "decision", box=SIMPLE_HEAD)
    entries = [(entry["task"], entry) for entry in info["per_task"]]
    if len(entries) > 1:
        entries.append(("all", info["overall"]))
    for name, entry in entries:
        low, high = entry["wilson_95"]
        table.add_row(
            name,
            f"{entry['n_successes']} of {entry['n_episodes']}",
            f"{entry['pc_success']:.0f} %",
            f"{low:.0f} to {high:.0f} %",
            "\n".join(f"{count} {kind}" for kind, count in sorted(entry["failures"].items())),
            f"{entry['decision_ms']:.0f} ms",
        )
    return table
