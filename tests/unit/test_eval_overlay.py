"""What the pictures show lies where it should, and videos play in browsers."""

from pathlib import Path

import av
import numpy as np
import pytest
from jaxtyping import UInt8

from dataset_tools import overlay
from dataset_tools.overlay import CHOSEN, GAP, MAIN, TARGET, TILE, TRUTH, Scene, View
from dataset_tools.video import VideoWriter

GREY = np.full((61, 61, 3), 90, np.uint8)


def scene(k: int, chosen: int | None = None, **changes: object) -> Scene:
    views = [View(f"camera{i}", GREY, 1 / k) for i in range(k)]
    return Scene("lift the cube", 1, views, chosen, **changes)


def tile(canvas: UInt8[np.ndarray, "y x 3"], index: int) -> UInt8[np.ndarray, "y2 x2 3"]:
    top, left = GAP + index * (TILE + GAP), MAIN + 2 * GAP
    return canvas[top : top + TILE, left : left + TILE]


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_only_the_chosen_view_is_framed(k: int) -> None:
    canvas = np.asarray(overlay.draw_scene(scene(k, chosen=k - 1)))
    assert canvas.shape == (overlay.HEIGHT, overlay.WIDTH, 3) and not any(side % 2 for side in canvas.shape[:2])
    if k <= 3:
        framed = [bool((tile(canvas, i)[0] == CHOSEN).all()) for i in range(k)]
        assert framed == [False] * (k - 1) + [True]


def test_heat_is_hottest_where_the_map_peaks_and_only_on_the_chosen_view() -> None:
    heat = np.zeros((61, 61), np.float32)
    heat[50, 20] = 3.0
    canvas = np.asarray(overlay.draw_scene(scene(3, chosen=1, heat=heat))).astype(int)
    plain = np.asarray(overlay.draw_scene(scene(3))).astype(int)
    change = np.abs(tile(canvas, 1) - 0.7 * tile(plain, 1)).sum(axis=-1)[4:-4, 4:-4]
    row, column = np.unravel_index(change.argmax(), change.shape)
    assert abs((row + 4) * 61 / TILE - 50) < 1.5 and abs((column + 4) * 61 / TILE - 20) < 1.5
    for other in (0, 2):
        assert np.array_equal(tile(canvas, other), tile(plain, other))


def test_target_crosses_surround_its_pixel_and_vanish_behind_the_camera() -> None:
    here = View("front", GREY, 0.5, np.array([30.0, 12.0]))
    behind = View("wrist", GREY, 0.5, np.array([np.nan, np.nan]))
    canvas = np.asarray(overlay.draw_scene(Scene("", 1, [here, behind])))
    rows, columns = np.nonzero((tile(canvas, 0) == TARGET).all(axis=-1))
    assert rows.mean() * 61 / TILE == pytest.approx(12.5, abs=1)
    assert columns.mean() * 61 / TILE == pytest.approx(30.5, abs=1)
    assert not (tile(canvas, 1) == TARGET).all(axis=-1).any()


def test_the_true_target_is_ringed_where_a_view_sees_it() -> None:
    seen = View("front", GREY, truth=np.array([30.0, 12.0]))
    rows, columns = np.nonzero((np.asarray(overlay.draw_tile(seen, 61, None, False)) == TRUTH).all(axis=-1))
    assert rows.mean() == pytest.approx(12.5, abs=1)
    assert columns.mean() == pytest.approx(30.5, abs=1)


def test_long_instructions_are_cut_to_the_picture() -> None:
    canvas = np.asarray(overlay.draw_scene(Scene("lift the cube " * 40, 1, [])))
    assert (canvas[:, -GAP:] == overlay.BACKGROUND).all()


def noise(frames: int, rows: int = 46, columns: int = 62) -> UInt8[np.ndarray, "n y x 3"]:
    return np.random.default_rng(0).integers(0, 255, (frames, rows, columns, 3), dtype=np.uint8)


def test_videos_are_h264_in_the_pixel_format_that_browsers_play(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.mp4"
    with VideoWriter(path, 20) as writer:
        for frame in noise(13):
            writer.add(frame)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.height, stream.width, stream.average_rate) == (46, 62, 20)
        assert sum(1 for _ in container.decode(stream)) == 13
    head = path.read_bytes()
    assert head.index(b"moov") < head.index(b"mdat"), "a browser can start before the whole file has arrived"


def test_interrupted_video_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", 20) as writer:
        writer.add(noise(1)[0])
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_odd_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="47 x 62"), VideoWriter(tmp_path / "a.mp4", 20) as writer:
        writer.add(noise(1, rows=47)[0])
