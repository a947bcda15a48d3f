"""Where a recording lives on disk: a workplace, and whether what lies there is the recording that is asked for."""

import json
from pathlib import Path
from typing import Any

from dataset_tools.record_settings import RecordSettings
from dataset_tools.workplace import Workplace

RECORDING_FILE = "meta/recording.json"
"""How a dataset was recorded: settings, seeds, attempts, success rate, versions."""


class RecordPlace(Workplace):
    """The directories of one recording; see ``Workplace``."""

    def __init__(self, root: Path, settings: RecordSettings, overwrite: bool) -> None:
        super().__init__(root, settings.as_json(), overwrite, "recorded")

    def finished(self, episodes: int) -> dict[str, Any] | None:
        """The recording's report if ``root`` already holds what is asked for; None if it is still to be made.

        Raises:
            ValueError: ``root`` holds something else that must not be touched.
        """
        if not self.root.exists() or (self.root.is_dir() and not any(self.root.iterdir())) or self._overwrite:
            self.check_free()
            return None
        advice = "choose another root, or replace it with --overwrite=true"
        if not (self.root / RECORDING_FILE).is_file():
            raise ValueError(f"{self.root} exists and is no finished recording; {advice}")
        report: dict[str, Any] = json.loads((self.root / RECORDING_FILE).read_text(encoding="utf-8"))
        self.check_settings(report["settings"], self.root, advice)
        if report["episodes"] < episodes:
            raise ValueError(f"{self.root} holds {report['episodes']} episodes, asked for are {episodes}; {advice}")
        return report
