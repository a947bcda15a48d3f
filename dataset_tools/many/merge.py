"""Finished pieces -> one dataset, by LeRobot's own aggregation, and one report over all episodes."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot.datasets.aggregate import aggregate_datasets
from rich.console import Console

from dataset_tools.columns import Columns
from dataset_tools.demonstrations import understand
from dataset_tools.hub.push import push_dataset
from dataset_tools.keyframe import KeyframeConfig, settings_of
from dataset_tools.keyframes import Keyframing
from dataset_tools.many.pieces import piece
from dataset_tools.replay import SOURCE_RECORDING_FILE
from dataset_tools.report import Report
from dataset_tools.source import open_source
from dataset_tools.workplace import Workplace
from lerobot_histmv import keys


@dataclass(frozen=True)
class MergePieces:
    """The last task of the engine.

    Attributes:
        config: options of the whole dataset.
        folder: where the pieces lie.
        pieces: how many there are.
        root: where the merged dataset shall be.
    """

    config: KeyframeConfig
    folder: Path
    pieces: int
    root: Path

    def __call__(self, data: object = None, rank: int = 0, world_size: int = 1) -> None:
        """Merge, remove the pieces, report.

        Raises:
            ValueError: a piece is missing, or the output place is not free.
        """
        roots = [piece(self.folder, number) for number in range(self.pieces)]
        missing = [root.name for root in roots if not (root / "meta/info.json").is_file()]
        if missing:
            raise ValueError(
                f"{len(missing)} of {self.pieces} pieces are not finished, the first is {missing[0]}: see "
                f"{self.folder}/logs, then give the same command again"
            )
        config, told = self.config, self.config.dataset
        source = open_source(told.repo_id, told.root, told.episodes, told.revision)
        demonstrations = understand(source, config.columns)
        report = merged_report(roots, config, demonstrations.columns, demonstrations.notices())
        place = Workplace(self.root, settings_of(config, source), config.overwrite, "keyframed")

        def write(path: Path) -> None:
            names = [f"local/{root.name}" for root in roots]
            aggregate_datasets(names, config.output.repo_id, roots, path)
            for name in (keys.INSTRUCTIONS_FILE, SOURCE_RECORDING_FILE):
                if (roots[0] / name).is_file():
                    shutil.copyfile(roots[0] / name, path / name)
            report.write(path)

        with place.opened():
            place.commit(write)
        shutil.rmtree(self.folder)
        report.show(Console())
        Console().print(f"written to {self.root}", highlight=False, soft_wrap=True)
        if config.output.push_to_hub:
            push_dataset(self.root, config.output.repo_id, config.output.private, config.output.license)


def merged_report(roots: Sequence[Path], config: KeyframeConfig, columns: Columns, notices: Sequence[str]) -> Report:
    """The pieces' reports as one."""
    told = [json.loads((root / keys.KEYFRAMING_FILE).read_text(encoding="utf-8")) for root in roots]
    found = [one for report in told for one in report["episodes"]]
    return Report(
        options=config.options(),
        source=config.dataset.repo_id,
        columns=columns,
        episodes={one.pop("source_episode"): Keyframing.from_json(one) for one in found},
        failures={int(number): why for report in told for number, why in report["replay"].items()},
        notices=list(dict.fromkeys([*notices, *(notice for report in told for notice in report["notices"])])),
    )
