"""What keyframing did: per episode and in total, as JSON beside the data, as Markdown, and on the terminal."""

import json
import platform
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import lerobot_histmv
from dataset_tools.columns import Columns
from dataset_tools.keyframes import KeyframeOptions, Keyframing
from dataset_tools.shards import appearing_whole
from lerobot_histmv import keys

FORMAT = 1
GAP_COUNTS_ABOVE = 1e-3
"""The median gap is over episodes whose optimum is above this mean error [m per frame]; elsewhere it is noise."""

SHOWN = 100
"""Episodes that the terminal shows; the file shows all."""

_MARKS = {"start": "s", "pause": "p", "gripper": "g", "ga": "+", "end": "e", "user": "u"}
_LEGEND = "pose frames: s start, p pause, g gripper change, + chosen by the method, e end, u asked for"


@dataclass(frozen=True)
class Report:
    """Everything that is told about a run.

    Attributes:
        options: how keyframes were chosen.
        source: repo id of the dense dataset.
        columns: columns used.
        episodes: keyframes by episode number of the source; gone through a few times, never held as a whole.
        failures: by episode, why executing its key poses failed, empty for a success; no entries without a replay.
        notices: what is missing in the dataset, was dropped or assumed.
    """

    options: KeyframeOptions
    source: str
    columns: Columns
    episodes: Mapping[int, Keyframing]
    failures: Mapping[int, str]
    notices: Sequence[str]

    @property
    def unit(self) -> str:
        """Unit of errors."""
        return "rad" if self.columns.is_joints else "m"

    @cached_property
    def reasons(self) -> dict[str, int]:
        """How many keyframes were kept for each reason."""
        counted = Counter(frame.reason for found in self.episodes.values() for frame in found.keyframes)
        return {reason: counted[reason] for reason in keys.REASONS}

    @cached_property
    def totals(self) -> dict[str, Any]:
        """Figures over all episodes."""
        figures = [
            (one.frames, one.error_mean, one.error_max, one.gap, one.optimum_mean, one.seconds, bool(one.warning))
            for one in self.episodes.values()
        ]
        frames, error_mean, error_max, gap, optimum_mean, seconds, warned = np.array(figures, dtype=np.float64).T
        kept, gaps = sum(self.reasons.values()), gap[optimum_mean > GAP_COUNTS_ABOVE]
        return {
            "episodes": len(figures),
            "frames": int(frames.sum()),
            "keyframes": kept,
            "rows": kept - len(figures),
            "keyframes_per_episode": kept / len(figures),
            "reasons": self.reasons,
            "share_of_method": self.reasons["ga"] / kept,
            "error_mean": float(error_mean.mean()),
            "error_max": float(error_max.max()),
            "median_gap": float(np.median(gaps)) if len(gaps) else None,
            "episodes_in_median_gap": len(gaps),
            "seconds_per_episode": float(seconds.mean()),
            "warnings": int(warned.sum()),
            "replayed": len(self.failures),
            "replay_failures": sum(map(bool, self.failures.values())),
        }

    def as_json(self) -> dict[str, Any]:
        """Content of ``meta/keyframing.json`` but for the episodes."""
        return {
            "format": FORMAT,
            "options": asdict(self.options),
            "unit": self.unit,
            "source": self.source,
            "columns": self.columns.chosen(),
            "notices": list(self.notices),
            "versions": {
                "histmv": lerobot_histmv.__version__,
                "lerobot": version("lerobot"),
                "numpy": np.__version__,
                "python": platform.python_version(),
            },
            "totals": self.totals,
            "replay": {str(number): failure for number, failure in self.failures.items()},
        }

    def rows(self) -> Iterator[tuple[str, ...]]:
        """Cells of the table, one row per episode; the head is ``head``."""
        for number, one in self.episodes.items():
            yield (
                str(number),
                str(one.frames),
                str(len(one.keyframes)),
                " ".join(f"{frame.pose_frame}{_MARKS[frame.reason]}" for frame in one.keyframes),
                *(f"{1000 * value:.1f}" for value in (one.error_sum, one.error_mean, one.error_max)),
                f"{100 * one.gap:.2f}",
                f"{1000 * one.seconds:.0f}",
            )

    def head(self) -> tuple[str, ...]:
        """Column titles of ``rows``."""
        milli = f"m{self.unit}"
        errors = (f"sum {milli}", f"mean {milli}", f"max {milli}")
        return ("episode", "frames", "kept", "pose frames", *errors, "gap %", "ms")

    def summary(self) -> list[str]:
        """A few lines for people."""
        total, unit = self.totals, f"m{self.unit}"
        why = ", ".join(f"{count} {reason}" for reason, count in total["reasons"].items())
        lines = [
            f"{total['episodes']} episodes of {total['frames']} frames -> {total['keyframes']} keyframes "
            f"({total['keyframes_per_episode']:.1f} per episode), {total['rows']} rows",
            f"kept because of: {why}; the method ({self.options.method}) chose {100 * total['share_of_method']:.0f} %",
            f"error: mean {1000 * total['error_mean']:.2f} {unit} per moving frame, largest "
            f"{1000 * total['error_max']:.1f} {unit}; accepted {1000 * self.options.epsilon:g} {unit}",
            self._gap(),
            f"processor time: {total['seconds_per_episode']:.3f} s per episode",
            "columns: " + ", ".join(f"{name} = {column}" for name, column in self.columns.chosen().items()),
        ]
        if self.failures:
            successes = total["replayed"] - total["replay_failures"]
            lines.append(f"replay: the key poses succeed in {successes} of {total['replayed']} episodes")
        lines += [f"note: {notice}" for notice in self.notices]
        return lines + [f"warning: {warning}" for warning in self._warnings()]

    def _gap(self) -> str:
        total = self.totals
        limit = f"whose optimum is above {1000 * GAP_COUNTS_ABOVE:g} m{self.unit} per frame"
        if total["median_gap"] is None:
            return f"gap to the exact optimum: not told, as there is no episode {limit}"
        median, count = 100 * total["median_gap"], total["episodes_in_median_gap"]
        return f"gap to the exact optimum: median {median:.2f} % over {count} episodes {limit}"

    def _warnings(self) -> list[str]:
        found = [f"episode {number}: {one.warning}" for number, one in self.episodes.items() if one.warning]
        for number, why in self.failures.items():
            fate = "kept" if number in self.episodes else "left out"
            found += [f"episode {number}: its key poses fail in replay ({why}); {fate}"] if why else []
        return found

    def json_lines(self) -> Iterator[str]:
        """``meta/keyframing.json``, each episode on a line of its own."""
        yield json.dumps(self.as_json(), indent=2, ensure_ascii=False).removesuffix("\n}") + ',\n  "episodes": ['
        separator = "\n"
        for number, one in self.episodes.items():
            yield separator + json.dumps({"source_episode": number, **asdict(one)}, ensure_ascii=False)
            separator = ",\n"
        yield "\n  ]\n}\n"

    def markdown_lines(self) -> Iterator[str]:
        """The report as a Markdown page."""
        yield f"# Keyframes of {self.source}\n\n"
        yield from (f"- {line}\n" for line in self.summary())
        yield f"\n{_LEGEND}\n\n"
        for row in chain([self.head(), tuple("---" for _ in self.head())], self.rows()):
            yield f"| {' | '.join(row)} |\n"

    def write(self, root: Path) -> None:
        """Put the report into the dataset at ``root``, as JSON and as Markdown, an episode at a time."""
        for path, lines in (
            (root / keys.KEYFRAMING_FILE, self.json_lines()),
            ((root / keys.KEYFRAMING_FILE).with_suffix(".md"), self.markdown_lines()),
        ):
            with appearing_whole(path) as file:
                file.writelines(lines)

    def show(self, console: Console) -> None:
        """Print the table and the summary."""
        table = Table(*self.head(), title=f"Keyframes of {self.source}", caption=_LEGEND)
        for row in islice(self.rows(), SHOWN):
            table.add_row(*row)
        if len(self.episodes) > SHOWN:
            table.add_row(*["..."] * len(self.head()))
        console.print(table)
        for line in self.summary():
            console.print(line, highlight=False, markup=False)
