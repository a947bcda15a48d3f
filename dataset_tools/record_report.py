"""What a recording tells: its progress, one line at the end, and ``meta/recording.json``."""

import importlib.metadata
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from huggingface_hub.constants import HF_HOME
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dataset_tools.record_settings import RecordSettings
from dataset_tools.shards import Outcome

PACKAGES = ("lerobot_policy_histmv", "lerobot", "datasets", "mujoco", "gymnasium", "numpy")


def recording_report(settings: RecordSettings, made: Sequence[Outcome]) -> dict[str, Any]:
    """How a dataset came about; the same for every run that leads to it.

    Args:
        settings: what decides the dataset.
        made: all attempts in order, up to the one that completed it.

    Returns:
        settings; episodes, rows, attempts, success rate; per episode its task, scene seed and variation; failed
        attempts; versions of the packages involved.
    """
    kept = [outcome for outcome in made if outcome.success]
    return {
        "settings": settings.as_json(),
        "episodes": len(kept),
        "rows": sum(outcome.rows for outcome in kept),
        "attempts": len(made),
        "success_rate": len(kept) / len(made),
        "tasks": [outcome.task for outcome in kept],
        "seeds": [outcome.seed for outcome in kept],
        "variations": [outcome.variation for outcome in kept],
        "failures": [
            {"task": outcome.task, "seed": outcome.seed, "variation": outcome.variation, "failure": outcome.failure}
            for outcome in made
            if not outcome.success
        ],
        "versions": {package: _version(package) for package in PACKAGES},
    }


def summary_line(report: dict[str, Any]) -> str:
    """One line: what the dataset holds and how often the expert succeeded."""
    failures = Counter(failure["failure"] for failure in report["failures"])
    why = f" ({', '.join(f'{kind}: {number}' for kind, number in failures.most_common())})" if failures else ""
    tasks = report["settings"]["tasks"]
    return (
        f"{tasks[0] if len(tasks) == 1 else f'{len(tasks)} tasks'}: {report['episodes']} episodes, {report['rows']} "
        f"rows; the expert succeeded in {report['episodes']} of {report['attempts']} attempts, "
        f"{100 * report['success_rate']:.1f} %{why}"
    )


def progress_bar(console: Console) -> Progress:
    """Bar over a recording's episodes."""
    columns = (MofNCompleteColumn(), TextColumn("episodes"), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(TextColumn("{task.description}"), BarColumn(), *columns, console=console)


def default_root(repo_id: str) -> Path:
    """Where LeRobot looks for the dataset ``repo_id``; LeRobot's own constant would take seconds to import."""
    home = os.environ.get("HF_LEROBOT_HOME") or Path(HF_HOME) / "lerobot"
    return Path(home).expanduser() / repo_id


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
