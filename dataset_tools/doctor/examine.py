"""The order of ``histmv doctor``'s checks: features, then all numbers, then sampled images; no finding follows another.

What rests on something already found wrong is not checked: an episode with NaN is left out, and so is a camera with an
error from what compares cameras.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from dataset_tools.columns import ColumnsConfig
from dataset_tools.doctor.calibration import evenly
from dataset_tools.doctor.findings import CHECKS, Finding, Severity
from dataset_tools.doctor.layout import describe
from dataset_tools.doctor.numbers import check_numbers, unusable
from dataset_tools.doctor.read import EpisodeRows, episode_rows
from dataset_tools.doctor.vectors import digest, same_episodes
from dataset_tools.doctor.views import check_images
from dataset_tools.source import Source


@dataclass(frozen=True)
class Examination:
    """What was found, and how much was looked at."""

    findings: tuple[Finding, ...]
    episodes: int
    frames: int
    sampled_episodes: int


def examine(
    source: Source,
    config: ColumnsConfig,
    sampled: int,
    for_histmv: bool,
    on_episode: Callable[[], None] = lambda: None,
) -> Examination:
    """Look at a dataset.

    Args:
        source: the dataset.
        config: which columns hold the tool's pose, where names do not tell.
        sampled: episodes whose images are looked at.
        for_histmv: whether what nobody but the histmv policy needs counts in full; else it is only noted.
        on_episode: called once per episode read, and once per sampled episode.
    """
    layout, findings = describe(source.features, sorted(source.depth_keys), config)
    chosen = {source.episodes[i] for i in evenly(len(source.episodes), sampled)}
    kept: dict[int, EpisodeRows] = {}
    digests: dict[int, str] = {}
    frames = 0
    for episode, rows in episode_rows(source):
        broken = [rows] if isinstance(rows, Finding) else unusable(source, rows)
        findings += broken
        if not broken and isinstance(rows, EpisodeRows):
            findings += check_numbers(source, layout, rows)
            digests[episode] = digest(rows.vectors)
            frames += len(rows.frame_index)
            if episode in chosen:
                kept[episode] = rows
        on_episode()
    findings += same_episodes(digests)
    for episode in sorted(chosen):
        if episode in kept:
            faulty = {finding.camera for finding in findings if finding.severity == Severity.ERROR}
            findings += check_images(source, layout, kept[episode], faulty)
        on_episode()
    if not for_histmv:
        findings = [noted(finding) for finding in findings]
    return Examination(tuple(dict.fromkeys(findings)), len(source.episodes), frames, len(kept))


def noted(finding: Finding) -> Finding:
    """A finding as of somebody who does not train the histmv policy."""
    return replace(finding, severity=Severity.NOTE) if CHECKS[finding.check].only_histmv else finding
