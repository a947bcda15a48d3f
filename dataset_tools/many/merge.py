"""Finished pieces -> one dataset, by LeRobot's own aggregation, and one report over all episodes."""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import aggregate
from rich.console import Console

from dataset_tools.columns import Columns
from dataset_tools.hub.push import push_dataset
from dataset_tools.keyframe import KeyframeConfig
from dataset_tools.keyframes import Keyframing
from dataset_tools.many.pieces import piece
from dataset_tools.replay import SOURCE_RECORDING_FILE
from dataset_tools.report import Report
from dataset_tools.workplace import Workplace
from lerobot_histmv import keys
from lerobot_histmv.data.memory import return_freed_memory

EPISODES_FILE_MB = 1
"""Size at which a file of episodes' metadata is closed."""
AT_ONCE = 20
"""Datasets that are merged at once: each takes most of a megabyte, beside what a single one takes."""
EPISODES_FILES = "meta/episodes/chunk-*/file-*.parquet"


@dataclass(frozen=True)
class MergePieces:
    """The last task of the engine; its memory does not grow with the number of pieces.

    Attributes:
        config: options of the whole dataset.
        settings: what decides the result, see ``keyframe.settings_of``.
        columns: columns of the whole dataset.
        notices: what is missing in it or assumed about it.
        folder: where the pieces lie.
        pieces: how many there are.
        root: where the merged dataset shall be.
    """

    config: KeyframeConfig = field(repr=False)
    settings: Mapping[str, Any] = field(repr=False)
    columns: Columns = field(repr=False)
    notices: tuple[str, ...] = field(repr=False)
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
        config = self.config
        report = merged_report(roots, config, self.columns, self.notices)
        place = Workplace(self.root, self.settings, config.overwrite, "keyframed")

        def write(path: Path) -> None:
            aggregated(roots, config.output.repo_id, path)
            for name in (keys.INSTRUCTIONS_FILE, SOURCE_RECORDING_FILE):
                if (roots[0] / name).is_file():
                    shutil.copyfile(roots[0] / name, path / name)
            report.write(path)

        with place.opened():
            place.commit(write)
        report.show(Console())
        shutil.rmtree(self.folder)
        Console().print(f"written to {self.root}", highlight=False, soft_wrap=True)
        if config.output.push_to_hub:
            push_dataset(self.root, config.output.repo_id, config.output.private, config.output.license)


def aggregated(roots: Sequence[Path], repo_id: str, path: Path) -> None:
    """LeRobot's aggregation of any number of datasets into one at ``path``, in their order, in bounded memory.

    LeRobot opens the metadata of all at once: more than ``AT_ONCE`` are merged in groups, and the groups again. Arrow's
    own allocators would keep what they freed.
    """
    pa.set_memory_pool(pa.system_memory_pool())
    with TemporaryDirectory(dir=path.parent) as scratch:
        level = 0
        while len(roots) > AT_ONCE:
            groups = [roots[first : first + AT_ONCE] for first in range(0, len(roots), AT_ONCE)]
            merged = [Path(scratch, f"{level}-{number}") for number in range(len(groups))]
            for group, place in zip(groups, merged, strict=True):
                aggregate_once(group, f"local/{place.name}", place)
            if level:
                for root in roots:
                    shutil.rmtree(root)
            roots, level = merged, level + 1
        aggregate_once(roots, repo_id, path)


def aggregate_once(roots: Sequence[Path], repo_id: str, path: Path) -> None:
    """LeRobot's aggregation, with the datasets' files of rows as they are.

    To fill files up, LeRobot would read and write the last one again for every dataset: memory grows with the file, to
    more than ten times its size for rows without images, and time with its square. The metadata of episodes are filled
    up whatever one asks for; small files keep that cheap.
    """
    names = [f"local/{root.name}" for root in roots]
    with patch.object(aggregate, "DEFAULT_DATA_FILE_SIZE_IN_MB", EPISODES_FILE_MB):
        aggregate.aggregate_datasets(names, repo_id, list(roots), path, concatenate_data=False)
    for file in path.glob(EPISODES_FILES):
        tell_place(file)
    return_freed_memory()


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


class PiecesKeyframings(Mapping[int, Keyframing]):
    """Keyframes by episode of the dense dataset, read from the reports of the pieces; one piece is held at a time.

    Args:
        roots: the pieces; no episode is in two of them.
    """

    def __init__(self, roots: Sequence[Path]) -> None:
        self._held: tuple[Path | None, dict[int, Keyframing]] = (None, {})
        self._root = {episode: root for root in roots for episode in self._of(root)}

    def _of(self, root: Path) -> dict[int, Keyframing]:
        if self._held[0] != root:
            found = told_by(root)["episodes"]
            self._held = (root, {one.pop("source_episode"): Keyframing.from_json(one) for one in found})
        return self._held[1]

    def __getitem__(self, episode: int) -> Keyframing:
        return self._of(self._root[episode])[episode]

    def __iter__(self) -> Iterator[int]:
        return iter(self._root)

    def __len__(self) -> int:
        return len(self._root)


def told_by(root: Path) -> dict[str, Any]:
    """A piece's report."""
    told: dict[str, Any] = json.loads((root / keys.KEYFRAMING_FILE).read_text(encoding="utf-8"))
    return told


def merged_report(roots: Sequence[Path], config: KeyframeConfig, columns: Columns, notices: Sequence[str]) -> Report:
    """The pieces' reports as one."""
    failures: dict[int, str] = {}
    all_notices = list(notices)
    for told in map(told_by, roots):
        failures |= {int(number): why for number, why in told["replay"].items()}
        all_notices += told["notices"]
    episodes = PiecesKeyframings(roots)
    return Report(
        config.options(), config.dataset.repo_id, columns, episodes, failures, list(dict.fromkeys(all_notices))
    )
