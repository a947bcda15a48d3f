"""A folder of results appears whole or not at all: leftovers are cleared or put back, errors change nothing."""

from pathlib import Path

import pytest

from dataset_tools.published import published

MARK = "page.html"


def test_what_a_killed_run_left_behind_is_cleared_or_put_back(tmp_path: Path) -> None:
    root, old, partial = tmp_path / "drawn", tmp_path / ".drawn.old", tmp_path / ".drawn.partial"
    old.mkdir()
    (old / MARK).write_text("old")
    partial.mkdir()
    (partial / "half").write_text("")
    with pytest.raises(ValueError, match=f"holds {MARK} already"), published(root, False, MARK):
        pass
    assert (root / MARK).read_text() == "old"
    with published(root, True, MARK) as path:
        (path / MARK).write_text("new")
    assert [entry.name for entry in tmp_path.rglob("*")] == ["drawn", MARK]
    assert (root / MARK).read_text() == "new"


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    root = tmp_path / "drawn"
    with published(root, False, MARK) as path:
        (path / MARK).write_text("old")
    with pytest.raises(RuntimeError), published(root, True, MARK) as path:
        (path / MARK).write_text("half")
        raise RuntimeError
    assert [entry.name for entry in tmp_path.rglob("*")] == ["drawn", MARK]
    assert (root / MARK).read_text() == "old"


def test_a_folder_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("")
    with pytest.raises(ValueError, match="is not replaced"), published(tmp_path, True, MARK):
        pass
    assert (tmp_path / "thesis.txt").exists()
