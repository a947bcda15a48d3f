"""Finished pieces -> one dataset, by LeRobot's own aggregation, and one report over all episodes."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import aggregate
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

EPISODES_FILE_MB, DATA_FILE_MB = 1, 20
"""Size at which a file of episodes' metadata, or of rows, is closed."""
EPISODES_FILES = "meta/episodes/chunk-*/file-*.parquet"


@dataclass(frozen=True)
class MergePieces:
    """The last task of the engine.

    Attributes:
        config: options of the whole dataset.
        folder: where the pieces lie.
        pieces: how many there are.
        root: where the merged dataset shall be.
    """

    config: KeyframeConfig = field(repr=False)
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
            aggregated(roots, config.output.repo_id, path)
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


def aggregated(roots: Sequence[Path], repo_id: str, path: Path) -> None:
    """LeRobot's aggregation into small files.

    LeRobot reads and writes the last file again for every piece, and would close it at 100 MB only. Rows without images
    take more than ten times as much memory as on disk; the metadata of 10,000 episodes takes four times as long.
    """
    names = [f"local/{root.name}" for root in roots]
    with patch.object(aggregate, "DEFAULT_DATA_FILE_SIZE_IN_MB", EPISODES_FILE_MB):
        aggregate.aggregate_datasets(names, repo_id, list(roots), path, DATA_FILE_MB)
    for file in path.glob(EPISODES_FILES):
        tell_place(file)


def tell_place(file: Path) -> None:
    """Correct what the rows of a file of episodes' metadata say about where they lie.

    LeRobot 0.6.1 fills it in before it opens a new file, so that a further aggregation would miss the last one.
    """
    table = pq.read_table(file)
    for what, name in (("chunk", file.parent.name), ("file", file.stem)):
        column = table.schema.get_field_index(f"meta/episodes/{what}_index")
        number = pa.repeat(pa.scalar(int(name.split("-")[1]), pa.int64()), table.num_rows)
        table = table.set_column(column, table.schema.field(column), number)
    pq.write_table(table, file)


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
