"""``histmv doctor``: what is wrong with a LeRobot dataset, before anything is trained on it."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import Progress

from dataset_tools.columns import ColumnsConfig
from dataset_tools.doctor import report
from dataset_tools.doctor.examine import Examination, examine
from dataset_tools.doctor.findings import Finding, Severity
from dataset_tools.keyframe import SourceConfig
from dataset_tools.shards import write_json
from dataset_tools.source import Source, open_dataset

Policy = Literal["histmv", "any"]


@dataclass
class DoctorConfig:
    """Check a LeRobot v3 dataset, dense or keyframed, ours or any other, before training on it.

        histmv doctor --dataset.repo_id=me/demos --dataset.root=demos

    Looked at are all numbers (NaN, time gaps, duplicates, quaternions, actions that are not reached, calibration) and
    the images of some episodes (damage, depth unit, invalid depth, views that disagree). Each finding tells where,
    what, and what to do about it; docs/doctor.md explains every check. The exit code is 1 if there is an error or a
    warning, else 0. Nothing is changed.
    """

    dataset: SourceConfig
    # Where the tool's pose lies, if names such as ee.x.pos or tcp_x do not tell.
    columns: ColumnsConfig = field(default_factory=ColumnsConfig)
    # Episodes, evenly spread, of which images are decoded (4 frames each); a large number takes all of them.
    sampled_episodes: int = 10
    # What is to be trained. With any, what only histmv needs (depth, calibration, a tool pose) is noted, not an error.
    policy: Policy = "histmv"
    # Exit with 0 in spite of warnings, once you have read them; errors still give 1.
    accept_warnings: bool = False
    # Also write all findings to this JSON file.
    json: Path | None = None

    def __post_init__(self) -> None:
        if self.sampled_episodes < 1:
            raise ValueError(f"sampled_episodes is {self.sampled_episodes}; it must be at least 1")


def run(config: DoctorConfig) -> None:
    """Look, print, write JSON if wanted; exits with 1 if something is to be mended."""
    console = Console()
    examination, root = diagnose(config, console)
    report.show(examination, console)
    if config.json:
        config.json.parent.mkdir(parents=True, exist_ok=True)
        write_json(config.json, report.as_json(config.dataset.repo_id, str(root), examination))
        console.print(f"findings: {config.json}", highlight=False, soft_wrap=True)
    grave = {Severity.ERROR} if config.accept_warnings else {Severity.ERROR, Severity.WARNING}
    if any(finding.severity in grave for finding in examination.findings):
        sys.exit(1)


def diagnose(config: DoctorConfig, console: Console) -> tuple[Examination, Path | None]:
    """What is found, and the folder looked into; a dataset that cannot be opened is a finding."""
    source = opened(config.dataset)
    if isinstance(source, Finding):
        return Examination((source,), 0, 0, 0), config.dataset.root
    steps = len(source.episodes) + min(config.sampled_episodes, len(source.episodes))
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("looking at episodes", total=steps)
        found = examine(
            source, config.columns, config.sampled_episodes, config.policy == "histmv", lambda: progress.advance(bar)
        )
    return found, source.root


def opened(dataset: SourceConfig) -> Source | Finding:
    """The dataset, or why LeRobot cannot open it."""
    try:
        return open_dataset(dataset.repo_id, dataset.root, dataset.episodes, dataset.revision)
    except Exception as error:  # damaged metadata, other versions of the format, no network: each has its own kind
        return Finding.of("damaged", f"cannot be opened: {type(error).__name__}: {error}")
