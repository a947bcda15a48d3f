"""Where a command builds a dataset on disk, and what may happen there: resume, refuse, replace.

Work on ``root`` is done in ``<root>.parts``: its settings, a lock, one shard per finished episode and, at the end, the
dataset being assembled. ``root`` itself appears by a rename, whole or not at all.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dataset_tools.locks import only_one
from dataset_tools.shards import write_json

_SETTINGS, _LOCK, _ASSEMBLED, _REPLACED = "settings.json", "lock", "dataset", "replaced"


class Workplace:
    """The directories of one dataset in the making.

    Args:
        root: where the dataset shall be.
        settings: what decides its content, as a JSON file gives it back.
        overwrite: whether a dataset or started work that is in the way may be replaced.
        done: what is done to the dataset, for messages: "recorded".
    """

    def __init__(self, root: Path, settings: Mapping[str, Any], overwrite: bool, done: str) -> None:
        self.root = root
        self.parts, self._removed = (root.with_name(f"{root.name}.{what}") for what in ("parts", "parts.removed"))
        self._settings, self._overwrite, self._done = settings, overwrite, done

    def check_free(self) -> None:
        """ValueError if ``root`` holds something that must not be touched."""
        if not self.root.exists() or (self.root.is_dir() and not any(self.root.iterdir())):
            return
        if not (self.root / "meta/info.json").is_file():
            raise ValueError(
                f"{self.root} exists and is no LeRobot dataset, so it is not replaced; choose another root"
            )
        if not self._overwrite:
            raise ValueError(f"{self.root} holds a dataset; choose another root, or replace it with --overwrite=true")

    def check_settings(self, found: Mapping[str, Any], where: Path, advice: str) -> None:
        """ValueError if the settings ``found`` at ``where`` are not these."""
        changes = [
            f"{name} was {found.get(name)!r} and is now {value!r}"
            for name, value in self._settings.items()
            if found.get(name) != value
        ]
        if changes:
            raise ValueError(f"{where} was {self._done} with other settings: {', '.join(changes)}; {advice}")

    @contextmanager
    def opened(self) -> Iterator[Path]:
        """Hold the working directory, made or taken over from a killed process; it is removed after a commit.

        Raises:
            ValueError: another process holds it, it belongs to work with other settings, or ``root`` is not free.
        """
        self.parts.mkdir(parents=True, exist_ok=True)
        self._refuse_foreign()
        with only_one(self.parts, f"{self.root} is being {self._done} by another process", _LOCK):
            self._put_back()
            shutil.rmtree(self._removed, ignore_errors=True)
            self.check_free()
            self._take_over()
            yield self.parts

    def _refuse_foreign(self) -> None:
        names = {path.name for path in self.parts.iterdir() if path.suffix != ".tmp"}
        if names - {_LOCK} and _SETTINGS not in names:
            raise ValueError(f"{self.parts} exists and holds no unfinished work; choose another root")

    def _put_back(self) -> None:
        """Undo what a kill between the two renames of a commit has done."""
        replaced = self.parts / _REPLACED
        if replaced.exists() and not self.root.exists():
            replaced.rename(self.root)

    def _take_over(self) -> None:
        settings_file = self.parts / _SETTINGS
        if settings_file.exists():
            found = json.loads(settings_file.read_text(encoding="utf-8"))
            try:
                advice = f"delete {self.parts}, choose another root, or start over with --overwrite=true"
                self.check_settings(found, self.parts, advice)
            except ValueError:
                if not self._overwrite:
                    raise
                self._clear()
        write_json(settings_file, self._settings)

    def _clear(self) -> None:
        for path in self.parts.iterdir():
            if path.is_file() and path.name not in (_SETTINGS, _LOCK):
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
        """Remove the working directory of finished work: all at once under its name, so that a kill leaves no half."""
        if (self.parts / _SETTINGS).exists():
            shutil.rmtree(self._removed, ignore_errors=True)
            self.parts.rename(self._removed)
            shutil.rmtree(self._removed)
