"""Nothing on disk is overwritten or mixed up by a recording that did not make it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from dataset_tools.record_place import RECORDING_FILE, RecordPlace
from dataset_tools.record_settings import RecordSettings

SETTINGS = RecordSettings(("pick_and_lift",), None, ("front", "wrist"), 32, 20, 0)


def write_dataset(directory: Path, episodes: int = 5) -> None:
    (directory / "meta").mkdir(parents=True)
    (directory / "meta" / "info.json").write_text("{}")
    report = {"settings": SETTINGS.as_json(), "episodes": episodes}
    (directory / RECORDING_FILE).write_text(json.dumps(report))


def place(root: Path, overwrite: bool = False, **changes: object) -> RecordPlace:
    return RecordPlace(root, replace(SETTINGS, **changes), overwrite)


def test_a_recording_appears_whole_and_leaves_nothing_else(tmp_path: Path) -> None:
    target = place(tmp_path / "data")
    assert target.finished(5) is None
    with target.opened():
        target.commit(write_dataset)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert target.finished(5) == target.finished(3)
    assert target.finished(5)["episodes"] == 5


def test_a_failed_assembly_leaves_no_dataset(tmp_path: Path) -> None:
    def fail(directory: Path) -> None:
        write_dataset(directory)
        raise OSError("disk full")

    target = place(tmp_path / "data")
    with pytest.raises(OSError, match="disk full"), target.opened():
        target.commit(fail)
    assert not (tmp_path / "data").exists()
    with target.opened():
        target.commit(write_dataset)
    assert target.finished(5)


@pytest.mark.parametrize("change", [{"fps": 10}, {"variation": 2}, {"cameras": ("front",)}, {"seed": 7}])
def test_a_dataset_with_other_settings_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    write_dataset(tmp_path / "data")
    with pytest.raises(ValueError, match=f"other settings: {next(iter(change))} was .*--overwrite"):
        place(tmp_path / "data", **change).finished(5)


def test_too_few_episodes_and_foreign_directories_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    with pytest.raises(ValueError, match="holds 5 episodes, asked for are 6"):
        place(tmp_path / "data").finished(6)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").touch()
    with pytest.raises(ValueError, match="no finished recording"):
        place(tmp_path / "photos").finished(5)
    with pytest.raises(ValueError, match="no LeRobot dataset, so it is not replaced"):
        place(tmp_path / "photos", overwrite=True).finished(5)


def test_overwriting_keeps_the_old_dataset_until_the_new_one_is_whole(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data", episodes=5)
    target = place(tmp_path / "data", overwrite=True, fps=10)
    assert target.finished(5) is None
    with target.opened():
        assert place(tmp_path / "data").finished(5)
        target.commit(lambda directory: write_dataset(directory, episodes=11))
    assert place(tmp_path / "data").finished(11)


def test_a_kill_between_the_renames_of_a_commit_loses_nothing(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data.parts" / "replaced")
    (tmp_path / "data.parts" / "settings.json").write_text(json.dumps(SETTINGS.as_json()))
    with pytest.raises(ValueError, match="holds a dataset"), place(tmp_path / "data").opened():
        pass
    assert place(tmp_path / "data").finished(5)


def test_a_started_recording_is_only_continued_with_its_settings(tmp_path: Path) -> None:
    with place(tmp_path / "data").opened() as parts:
        (parts / "attempt-000000.json").write_text("{}")
    with pytest.raises(ValueError, match="fps was 20 and is now 10"), place(tmp_path / "data", fps=10).opened():
        pass
    with place(tmp_path / "data").opened():
        assert (parts / "attempt-000000.json").exists()
    with place(tmp_path / "data", overwrite=True, fps=10).opened():
        assert not (parts / "attempt-000000.json").exists()


def test_a_kill_while_the_working_directory_is_removed_leaves_nothing_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(path: Path, **_: bool) -> None:
        if path.exists():
            for name in ("settings.json", "attempt-000000.json"):
                (path / name).unlink()
            raise KeyboardInterrupt

    target = place(tmp_path / "data")
    with pytest.raises(KeyboardInterrupt), target.opened() as parts:
        for name in ("attempt-000000.json", "attempt-000001.json"):
            (parts / name).write_text("{}")
        monkeypatch.setattr(shutil, "rmtree", killed)
        target.clean_up()
    monkeypatch.undo()
    with place(tmp_path / "data").opened() as parts:
        assert not list(parts.glob("attempt-*"))
    assert [path.name for path in tmp_path.iterdir()] == ["data.parts"]


def test_a_working_directory_is_never_shared_nor_taken_from_others(tmp_path: Path) -> None:
    target = place(tmp_path / "data")
    busy = pytest.raises(ValueError, match="being recorded by another process")
    with target.opened(), busy, place(tmp_path / "data").opened():
        pass
    (tmp_path / "other.parts").mkdir()
    (tmp_path / "other.parts" / "thesis.tex").touch()
    with (
        pytest.raises(ValueError, match="holds no unfinished work"),
        place(tmp_path / "other", overwrite=True).opened(),
    ):
        pass
    assert [path.name for path in (tmp_path / "other.parts").iterdir()] == ["thesis.tex"]
