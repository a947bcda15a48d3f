"""Where a recording (or a conversion) lives on disk, and what may happen there: resume, refuse, replace.

A recording of ``root`` works in ``<root>.parts``: its settings, a lock, one shard per finished attempt and, at the end,
the dataset being assembled. ``root`` itself appears by a rename, whole or not at all.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from dataset_tools.locks import only_one
from dataset_tools.shards import write_json

RECORDING_FILE = "meta/recording.json"
"""How a dataset was recorded: settings, seeds, attempts, success rate, versions."""
_SETTINGS, _LOCK, _ASSEMBLED, _REPLACED = "settings.json", "lock", "dataset", "replaced"


@runtime_checkable
class Settings(Protocol):
    """What decides the content of a dataset in the making."""

    def as_json(self) -> dict[str, Any]:
        """The same as a JSON file gives it back."""

    def check_same(self, found: Mapping[str, Any], where: Path, advice: str) -> None:
        """Raise ValueError if the settings ``found`` at ``where`` are not these."""


class RecordPlace:
    """The directories of one recording.

    Args:
        root: where the dataset shall be.
        settings: what decides its content.
        overwrite: whether a dataset or a started recording that is in the way may be replaced.
    """

    def __init__(self, root: Path, settings: Settings, overwrite: bool) -> None:
        self.root = root
        self.parts = root.with_name(f"{root.name}.parts")
        self._settings, self._overwrite = settings, overwrite

    def finished(self, episodes: int) -> dict[str, Any] | None:
        """The recording's report if ``root`` already holds what is asked for; None if it is still to be made.

        Raises:
            ValueError: ``root`` holds something else that must not be touched.
        """
        if not self.root.exists() or (self.root.is_dir() and not any(self.root.iterdir())):
            return None
        if self._overwrite:
            if not (self.root / "meta" / "info.json").is_file():
                raise ValueError(f"{self.root} is no LeRobot dataset, so it is not replaced; choose another root")
            return None
        advice = "choose another root, or replace it with --overwrite=true"
        if not (self.root / RECORDING_FILE).is_file():
            raise ValueError(f"{self.root} exists and is no finished recording; {advice}")
        report = json.loads((self.root / RECORDING_FILE).read_text(encoding="utf-8"))
        self._settings.check_same(report["settings"], self.root, advice)
        if report["episodes"] < episodes:
            raise ValueError(f"{self.root} holds {report['episodes']} episodes, asked for are {episodes}; {advice}")
        return report

    @contextmanager
    def opened(self) -> Iterator[Path]:
        """Hold the working directory, made or taken over from a killed recording; it is removed after a commit.

        Raises:
            ValueError: another process holds it, or it belongs to a recording with other settings.
        """
        self.parts.mkdir(parents=True, exist_ok=True)
        self._refuse_foreign()
        with only_one(self.parts, f"{self.root} is being written by another process", _LOCK):
            self._take_over()
            yield self.parts

    def _refuse_foreign(self) -> None:
        names = {path.name for path in self.parts.iterdir() if path.suffix != ".tmp"}
        if names - {_LOCK} and _SETTINGS not in names:
            raise ValueError(
                f"{self.parts} exists and was not made by a recording or a conversion; choose another root"
            )

    def _take_over(self) -> None:
        settings_file = self.parts / _SETTINGS
        if settings_file.exists():
            found = json.loads(settings_file.read_text(encoding="utf-8"))
            try:
                advice = f"delete {self.parts}, choose another root, or start over with --overwrite=true"
                self._settings.check_same(found, self.parts, advice)
            except ValueError:
                if not self._overwrite:
                    raise
                self._clear()
        write_json(settings_file, self._settings.as_json())

    def _clear(self) -> None:
        for path in self.parts.glob("attempt-*"):
            path.unlink()

    def commit(self, write_dataset: Callable[[Path], None]) -> None:
        """Let ``write_dataset`` write a dataset into a directory, then rename that to ``root``. Call while opened."""
        assembled, replaced = self.parts / _ASSEMBLED, self.parts / _REPLACED
        for leftover in (assembled, replaced):
            shutil.rmtree(leftover, ignore_errors=True)
        write_dataset(assembled)
        if self.root.exists():
            self.root.rename(replaced)
        assembled.rename(self.root)
        self.clean_up()

    def clean_up(self) -> None:
        """Remove the working directory of a finished recording."""
        if (self.parts / _SETTINGS).exists():
            shutil.rmtree(self.parts)
