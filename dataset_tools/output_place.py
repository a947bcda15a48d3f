"""Where a tool writes a new dataset, as its options say."""

from dataclasses import dataclass
from pathlib import Path

from dataset_tools.record_report import default_root


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
