"""Which dataset a tool reads as a whole, and where it writes a new one, as its options say."""

from dataclasses import dataclass
from pathlib import Path

from dataset_tools.record_report import default_root


@dataclass
class WholeDataset:
    """The dataset to read; it is not changed."""

    # Name, such as user/demonstrations. Without a root it is looked for locally, then on the Hub, as LeRobot does.
    repo_id: str
    # Folder that holds the dataset.
    root: Path | None = None
    # Branch, tag or commit on the Hub.
    revision: str | None = None


@dataclass
class OutputPlace:
    """The dataset to write."""

    # Name of the new dataset, such as user/demonstrations.
    repo_id: str
    # Folder to write; by default LeRobot's own place for this repo_id.
    root: Path | None = None

    def folder(self) -> Path:
        """The folder, as an absolute path."""
        return (self.root or default_root(self.repo_id)).expanduser().resolve()
