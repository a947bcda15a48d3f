"""The findings of ``histmv doctor`` as a table, as JSON, and in one sentence."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from dataset_tools.doctor.examine import Examination
from dataset_tools.doctor.findings import Finding, Severity

STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.NOTE: "cyan"}
LISTED = 8
"""Episodes that a row of the table lists."""


def grouped(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Findings of one check, camera and severity together; gravest first, else as found."""
    groups: dict[tuple[Severity, str, str], list[Finding]] = defaultdict(list)
    for finding in findings:
        groups[finding.severity, finding.check, finding.camera].append(finding)
    order = list(Severity)
    return sorted(groups.values(), key=lambda group: order.index(group[0].severity))


def where(group: Sequence[Finding]) -> str:
    """Camera, first place and the other episodes of a group."""
    first = group[0]
    parts = [first.camera] if first.camera else []
    if first.episode is not None:
        frame = "" if first.frame is None else f", frame {first.frame}"
        parts.append(f"episode {first.episode}{frame}")
    others = sorted({finding.episode for finding in group if finding.episode not in (None, first.episode)})
    if others:
        more = f" and {len(others) - LISTED} more" if len(others) > LISTED else ""
        parts.append(f"also in {', '.join(map(str, others[:LISTED]))}{more}")
    return "\n".join(parts)


def table(findings: Sequence[Finding]) -> Table:
    """One row per check and camera, each with what to do."""
    shown = Table(show_lines=True)
    for heading in ("", "check", "where", "what", "what to do"):
        shown.add_column(heading, ratio=3 if heading.startswith("what") else None, overflow="fold")
    for group in grouped(findings):
        first = group[0]
        severity = Text(first.severity, STYLES[first.severity])
        shown.add_row(severity, *map(Text, (first.check, where(group), first.message, first.remedy)))
    return shown


def verdict(examination: Examination) -> str:
    """One sentence: how much was looked at and what came of it."""
    counts = Counter(finding.severity for finding in examination.findings)
    seen = (
        f"{examination.episodes} episodes with {examination.frames} frames, "
        f"images of {examination.sampled_episodes} episodes"
    )
    if not counts:
        return f"healthy: nothing found in {seen}"
    told = ", ".join(
        f"{counts[severity]} {severity}{'s'[: counts[severity] - 1]}" for severity in Severity if severity in counts
    )
    if counts[Severity.ERROR]:
        ready = "not ready for training"
    else:
        ready = "to be looked at before training" if counts[Severity.WARNING] else "ready for training"
    return f"{ready}: {told} in {seen}"


def as_json(dataset: str, root: str, examination: Examination) -> dict[str, Any]:
    """All findings and what was looked at."""
    counts = Counter(finding.severity for finding in examination.findings)
    return {
        "dataset": dataset,
        "root": root,
        "episodes": examination.episodes,
        "frames": examination.frames,
        "sampled_episodes": examination.sampled_episodes,
        "counts": {str(severity): counts[severity] for severity in Severity},
        "findings": [
            {
                "check": finding.check,
                "severity": str(finding.severity),
                "episode": finding.episode,
                "frame": finding.frame,
                "camera": finding.camera or None,
                "message": finding.message,
                "remedy": finding.remedy,
            }
            for finding in examination.findings
        ],
    }


def show(examination: Examination, console: Console) -> None:
    """Print the table and the verdict."""
    if examination.findings:
        console.print(table(examination.findings))
    console.print(verdict(examination), highlight=False, soft_wrap=True)
