"""``histmv inspect`` on small datasets: everything is drawn and in one page, what is lacking is left out and said."""

import base64
import io
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from helpers import episodes
from PIL import Image

from dataset_tools import cli
from dataset_tools.inspect.command import PAGE, InspectConfig, InspectedConfig, read_episodes, run
from dataset_tools.inspect.panels import PANELS, left_out
from dataset_tools.inspect.rerun import require_rerun, write_recording
from dataset_tools.keyframe import KeyframeConfig, OutputConfig, SourceConfig
from dataset_tools.keyframe import run as run_keyframe
from dataset_tools.page import Chapter, page
from dataset_tools.source import open_dataset
from lerobot_histmv import keys

ALL = [panel.name for panel in PANELS]


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return episodes.write_picks(tmp_path_factory.mktemp("inspect") / "dense")


@pytest.fixture(scope="module")
def keyframed(dense: Path) -> Path:
    root = dense.with_name("keys")
    run_keyframe(KeyframeConfig(SourceConfig("test/dense", dense), OutputConfig("test/keys", root)))
    return root


class Links(HTMLParser):
    """Everything that a page points to."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]


def assert_self_contained(page: str, images: int) -> None:
    """It points to nothing outside, runs nothing, and all its ``images`` decode at 1200 pixels or so."""
    links = Links()
    links.feed(page)
    assert not links.tags & {"script", "iframe", "link", "object", "embed"}
    assert "url(" not in page
    assert "@import" not in page
    pictures = [link for link in links.found if not link.startswith("#")]
    assert len(pictures) == images
    for picture in pictures:
        head, _, data = picture.partition(",")
        assert head == "data:image/png;base64"
        assert Image.open(io.BytesIO(base64.b64decode(data, validate=True))).convert("RGB").width > 400


def names(folder: Path) -> list[str]:
    return sorted(re.sub(r"episode_0*(\d+)_(\w+).png", r"\1 \2", path.name) for path in folder.iterdir())


def config(repo_id: str, root: Path, **options: object) -> InspectConfig:
    return InspectConfig(InspectedConfig(repo_id, root, [0]), **options)  # type: ignore[arg-type]


def test_the_command_draws_everything_and_refuses_to_replace(
    dense: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    flags = ["--dataset.repo_id=test/dense", f"--dataset.root={dense}", "--dataset.episodes=[1]", f"--output={output}"]
    cli.main(["inspect", *flags, "--epsilon=0.002"])
    assert names(output) == sorted([*(f"1 {name}" for name in ALL), PAGE])
    page = (output / PAGE).read_text()
    assert_self_contained(page, len(ALL))
    assert "accepted 2 mm" in page
    assert episodes.TASK in page
    assert "1 of 2 episodes" in page
    assert str(output / PAGE) in capsys.readouterr().out.replace("\n", "")
    with pytest.raises(SystemExit):
        cli.main(["inspect", *flags])
    assert "--overwrite=true" in capsys.readouterr().err
    assert (output / PAGE).read_text() == page


def test_foreign_folders_are_never_replaced(dense: Path, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(ValueError, match="is not replaced"):
        run(config("test/dense", dense, output=tmp_path, overwrite=True))


def test_without_calibration_the_rest_is_drawn(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    features = episodes.dense_features()
    for key in (keys.INTRINSICS, keys.EXTRINSICS):
        del features[key]
    frames = episodes.with_cameras(episodes.vector_frames(episodes.pick(rng)), rng)
    bare = [{key: value for key, value in frame.items() if key in features} for frame in frames]
    root = episodes.write(tmp_path / "bare", [bare], features)
    episodes.edit_info(root, lambda info: None)
    run(config("test/dense", root, output=tmp_path / "out"))
    assert names(tmp_path / "out") == ["0 errors", "0 keyframes", "0 trajectory", PAGE]
    page = (tmp_path / "out" / PAGE).read_text()
    assert page.count("camera calibration: observation.camera_intrinsics") == 2
    assert_self_contained(page, 3)


def test_a_dataset_of_vectors_alone_needs_no_cameras(tmp_path: Path) -> None:
    root = episodes.write_vector_picks(tmp_path / "vectors", 1)
    (episode,) = read_episodes(open_dataset("test/dense", root), config("test/dense", root))
    assert [panel.name for panel in PANELS if not panel.lacking(episode)] == ["trajectory", "errors"]
    assert all("colour images" in note for note in left_out(episode))


def test_a_keyframed_dataset_tells_what_the_dense_one_does(dense: Path, keyframed: Path) -> None:
    (sparse,) = read_episodes(open_dataset("test/keys", keyframed, [1]), config("test/keys", keyframed))
    given = config("test/keys", keyframed, source_root=dense)
    (both,) = read_episodes(open_dataset("test/keys", keyframed, [1]), given)
    (whole,) = read_episodes(open_dataset("test/dense", dense, [1]), config("test/dense", dense))
    assert sparse.motion is None
    assert "--source_root" in sparse.notes[0]
    assert both.motion is not None
    assert whole.motion is not None
    np.testing.assert_array_equal(both.motion.errors, whole.motion.errors)
    for episode in (sparse, both):
        assert [(pose.reason, pose.frames) for pose in episode.poses] == [
            (pose.reason, pose.frames) for pose in whole.poses
        ]
        for mine, theirs in zip(episode.poses[1:], whole.poses[1:], strict=True):
            np.testing.assert_array_equal(mine.position, theirs.position)
            assert mine.gripper == theirs.gripper
        for seen, known in zip(episode.observations, whole.observations[:-1], strict=True):
            assert seen.seconds == pytest.approx(known.seconds)
            np.testing.assert_array_equal(seen.position, known.position)
            np.testing.assert_array_equal(seen.views["wrist"].depth, known.views["wrist"].depth)
            np.testing.assert_array_equal(seen.views["wrist"].world_from_cam, known.views["wrist"].world_from_cam)


@pytest.mark.parametrize("content", [None, "{", '{"options": {}}', '{"options": [], "episodes": 3}'])
def test_a_keyframed_dataset_is_read_without_its_report(keyframed: Path, tmp_path: Path, content: str | None) -> None:
    report = keyframed / keys.KEYFRAMING_FILE
    whole = report.read_text()
    try:
        report.unlink() if content is None else report.write_text(content)
        (episode,) = read_episodes(open_dataset("test/keys", keyframed, [0]), config("test/keys", keyframed))
    finally:
        report.write_text(whole)
    assert [pose.reason for pose in episode.poses][:2] == ["start", "gripper"]
    assert episode.poses[-1].reason == "end"
    assert all(pose.frames is None for pose in episode.poses)
    assert any("keyframing.json is missing or speaks of other rows" in note for note in episode.notes)


def test_a_source_root_makes_no_sense_for_a_dense_dataset(dense: Path) -> None:
    with pytest.raises(ValueError, match="is the dense dataset itself"):
        list(read_episodes(open_dataset("test/dense", dense), config("test/dense", dense, source_root=dense)))


def test_text_of_the_dataset_cannot_become_markup(dense: Path) -> None:
    bad = "<script>alert(1)</script>"
    text = page("<b>", "&", [Chapter("episode 0", bad, bad, ["<img src=http://x>"], "", [])])
    assert_self_contained(text, 0)


def test_rerun_is_asked_for_in_words_where_it_is_missing(dense: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="pip install rerun-sdk"):
        run(config("test/dense", dense, output=dense.with_name("never"), rerun=True))
    assert not dense.with_name("never").exists()


def test_a_rerun_recording_is_written(dense: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    assert require_rerun().__name__ == "rerun"
    (episode,) = read_episodes(open_dataset("test/dense", dense, [0]), config("test/dense", dense))
    write_recording(episode, tmp_path / "one.rrd")
    assert (tmp_path / "one.rrd").read_bytes()[:3] == b"RRF"
