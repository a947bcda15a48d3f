"""Pictures and sentences of ``histmv explain`` show the numbers of the records where they belong."""

import dataclasses
import re
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from helpers.explaining import CHOOSING, STEPS, act, made_up, policy_choosing
from matplotlib.axes import Axes
from PIL import Image, ImageDraw
from tiny_policy import TASK, episode, observation, tiny_config, tiny_policy
from tiny_scene import SIZE, tiny_network

from dataset_tools.eval_film import HOLD_SECONDS
from dataset_tools.explain.board import BAR, LARGEST, LEFT, LINE, decision_text, draw_board, seen_target, tile
from dataset_tools.explain.chapter import PANELS, decision_table, facts, notes
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.sheet import ExplainedFilm
from dataset_tools.explain.step_panels import draw_history, draw_poses
from dataset_tools.explain.view_panels import THUMB, draw_information, draw_weights
from dataset_tools.explain.watch import Record, watched
from dataset_tools.overlay import CHOSEN, GAP, MUTED, TARGET, TRUTH, Scene
from dataset_tools.page import draw_panels
from lerobot_histmv.geometry import project
from lerobot_histmv.model.config import HistoryConfig


@pytest.fixture(scope="module", params=CHOOSING)
def acted(request: pytest.FixtureRequest) -> tuple[torch.Tensor, list[Record]]:
    return act(policy_choosing(request.param))


def test_every_view_s_heat_is_drawn_where_it_peaks(acted: tuple[torch.Tensor, list[Record]]) -> None:
    last, rows, columns = acted[1][-1], *acted[1][-1].heat.shape[1:]
    views = {name: dataclasses.replace(view, color=np.full_like(view.color, 90)) for name, view in last.views.items()}
    peaks = [(5, 31), (23, 9)]
    heat = np.zeros_like(last.heat)
    for index, peak in enumerate(peaks):
        heat[index, peak[0] - 1 : peak[0] + 2, peak[1] - 1 : peak[1] + 2] = 1
    away = np.array([9.0, 9.0, -9.0, 1, 0, 0, 0, 1])  # no cross covers the heat
    board = np.asarray(
        draw_board([dataclasses.replace(last, views=views, heat=heat, action=away, attention=np.ones((2, 1)))])
    )
    scale, inset = LARGEST / columns, (LARGEST - LARGEST * rows / columns) / 2
    for index, (row, column) in enumerate(peaks):
        left = index * (LARGEST + 4)
        tile = board[LINE + 2 : LINE + 2 + LARGEST, left : left + LARGEST].astype(int)[6:-6, 6:-6]
        hot = np.argwhere(tile[..., 0] - tile[..., 2] > 60).mean(axis=0) + 6
        assert hot == pytest.approx([(row + 0.5) * scale + inset, (column + 0.5) * scale], abs=3)


def test_a_film_stops_once_for_each_decision_however_many_ticks_it_is_held(tmp_path: Path) -> None:
    decisions, fps, frames = made_up([0, 2]), 5, np.zeros((1, 8, 8, 3), np.uint8)
    shown: list[Record] = []
    film = ExplainedFilm(shown, tmp_path / "film.mp4", fps)
    for ticks, decision in zip((3, 4), decisions, strict=True):
        shown.append(decision)
        for tick in range(ticks):
            film.show(Scene(TASK, tick + 1), list(frames))
    film.finish("", True)
    with av.open(str(tmp_path / "film.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 3 + 4 + 3 * HOLD_SECONDS * fps


def test_errors_are_measured_and_a_better_view_is_named(acted: tuple[torch.Tensor, list[Record]]) -> None:
    truth = acted[0].numpy().copy()
    truth[3, :3] = acted[1][3].targets[1 - acted[1][3].chosen]  # at the fourth decision the other view was right
    truth[5, 0] += 0.003
    truth[:, 7] = 1 - truth[:, 7]
    told = Explained("episode 0", TASK, acted[1], truth)
    assert told.errors[5] == pytest.approx(0.003, abs=1e-5)
    assert not told.gripper_right.any()
    assert told.turns.max() < 0.1
    assert f"gripper right in 0 of {STEPS}" in facts(told)
    (note,) = notes(told)
    assert note.startswith("decision 4: ")
    assert note.endswith("alone would have been 0 cm off")


def test_panels_draw_the_numbers_of_the_records(acted: tuple[torch.Tensor, list[Record]]) -> None:
    told = Explained("episode 0", TASK, acted[1], acted[0].numpy() + 0.1)
    *_, weights, scores = draw_weights(told).findobj(Axes)
    for axes, values in ((weights, told.weights), (scores, told.scores)):
        lines = [line.get_ydata() for line in axes.lines if line.get_linestyle() == "-"]
        np.testing.assert_allclose(np.stack(lines, axis=1), values)
        assert sum(line.get_linestyle() == ":" for line in axes.lines) == len(told.changes)
    *layers, moved = draw_history(told).findobj(Axes)
    for layer, axes in enumerate(layers):
        drawn = np.ma.filled(axes.images[0].get_array(), np.nan) / 100
        np.testing.assert_allclose(drawn[-1], acted[1][-1].attention[layer], atol=1e-6)
        assert np.isnan(drawn[0, 1:]).all(), "no step looks ahead"
    np.testing.assert_allclose(moved.images[0].get_array()[-1, : STEPS - 1] / 100, acted[1][-1].influence, atol=1e-6)
    mean, *each = [axes.images[0].get_array() for axes in draw_information(told).findobj(Axes) if axes.texts]
    np.testing.assert_allclose(mean, told.information.mean(axis=0))
    np.testing.assert_allclose(each, told.information)
    positions, errors = draw_poses(told).findobj(Axes)
    predicted = [line.get_ydata() for line in positions.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(np.stack(predicted, axis=1), told.actions[:, :3])
    heights = [bar.get_height() for bar in errors.patches]
    np.testing.assert_allclose(heights, 1000 * told.errors, atol=1e-3)


def test_without_history_its_panel_is_left_out(tmp_path: Path) -> None:
    policy = tiny_policy(tiny_config(network=tiny_network(history=HistoryConfig(enabled=False, layers=2, heads=2))))
    policy.reset()
    with watched(policy) as records:
        for step in range(3):
            policy.select_action(observation(episode(3), step))
    assert all(record.memory == 0 and len(record.influence) == 0 for record in records)
    exhibits = draw_panels(PANELS, Explained("episode 0", TASK, records), tmp_path, "episode")
    assert {one.path.name for one in exhibits} == {"episode_views.png", "episode_poses.png", "episode_information.png"}


def test_targets_are_marked_where_the_pinhole_camera_sees_them(acted: tuple[torch.Tensor, list[Record]]) -> None:
    view = acted[1][0].views["wrist"]
    assert view.intrinsics is not None
    assert view.world_from_cam is not None
    point = view.world_from_cam @ np.array([0.1, 0.05, 0.5, 1.0])  # in the camera's frame, made a world point
    fx, fy, cx, cy = view.intrinsics
    assert seen_target(view, point) == pytest.approx([fx * 0.2 + cx, fy * 0.1 + cy], abs=1e-3)
    assert project(point[None], view.intrinsics, view.world_from_cam)[1][0] == pytest.approx(0.5, abs=1e-5)


SIDE, CHOSEN_VIEWS = 192, (2, 0, 0, 1)


def centre(picture: Image.Image, color: tuple[int, int, int]) -> np.ndarray:
    """Mean column and row of the pixels of a colour."""
    rows, columns = np.nonzero((np.asarray(picture) == color).all(axis=-1))
    return np.array([columns.mean(), rows.mean()])


def test_a_cross_marks_where_the_tool_is_sent_and_a_ring_where_the_demonstration_went() -> None:
    (record,) = made_up([1])
    truth = record.action + np.array([0.02, -0.05, 0.03, 0, 0, 0, 0, 0])
    scale = SIDE / SIZE[1]
    inset = (SIDE - scale * np.array(SIZE[::-1])) / 2
    for index, view in enumerate(record.views.values()):
        picture = tile(record, index, SIDE, truth)
        for color, point in ((TARGET, record.action), (TRUTH, truth)):
            expected = (seen_target(view, point[:3]) + 0.5) * scale + inset
            assert centre(picture, color) == pytest.approx(expected, abs=1.5)
        assert not (np.asarray(tile(record, index, SIDE, None)) == TRUTH).all(axis=-1).any()


@pytest.fixture
def words(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Filled with all that is written into pictures, in order."""
    found: list[str] = []
    write = ImageDraw.ImageDraw.text

    def note(self: ImageDraw.ImageDraw, place: tuple[float, float], text: str, **options: object) -> None:
        found.append(text)
        write(self, place, text, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", note)
    return found


def test_boards_tell_weight_and_heat_of_every_view_by_name(words: list[str]) -> None:
    record = made_up(CHOSEN_VIEWS)[-1]
    board = np.asarray(draw_board([dataclasses.replace(record, attention=np.ones((2, 1)), influence=np.zeros(0))]))
    expected, side = [], LARGEST
    for index, camera in enumerate(record.views):
        acts = index == record.chosen
        expected.append(f"{camera}: acts" if acts else camera)
        left = index * (side + GAP)
        start, end = left + LEFT, left + side - 2 * GAP - 28
        for line, (name, shares) in enumerate((("weight", record.weights), ("heat", record.support))):
            expected += [name, f"{100 * shares[index]:.0f} %"]
            row = board[LINE + 2 + side + GAP + line * LINE + 4 + BAR // 2, start : end + 1]
            filled = (row == (CHOSEN if acts else MUTED)).all(axis=-1)
            assert filled.sum() - 1 == pytest.approx((end - start) * shares[index], abs=1)
        away = 100 * np.linalg.norm(record.targets[index] - record.action[:3])
        expected.append(f"alone: {away:.1f} cm elsewhere")
    assert words[: len(expected)] == expected


def test_boards_tell_attention_and_influence_of_every_step(words: list[str]) -> None:
    records = made_up(CHOSEN_VIEWS)
    draw_board(records)
    told = words[words.index("attention over steps") + 1 :]
    assert told.pop(0) == f"without its past: target {100 * records[-1].memory:.1f} cm elsewhere, gripper closed"
    expected = []
    for step, share in enumerate(records[-1].attention.mean(axis=0)):
        now = step == len(records) - 1
        expected += ["now" if now else f"{step + 1}", f"{100 * share:.0f}%"]
        expected += [] if now else [f"{100 * records[-1].influence[step]:.1f} cm"]
    assert told == expected


def test_every_thumbnail_is_of_the_view_that_acted_and_has_its_name() -> None:
    records = made_up(CHOSEN_VIEWS)
    told = Explained("episode 0", TASK, records, np.stack([one.action for one in records]) + 0.01)
    shown = [axes for axes in draw_weights(told).findobj(Axes) if axes.images]
    assert len(shown) == len(records)
    for step, (axes, record, truth) in enumerate(zip(shown, records, told.truth, strict=True)):
        assert axes.get_title() == f"{step + 1}: {list(record.views)[record.chosen]}"
        drawn = axes.images[0].get_array()
        for view in range(len(record.views)):
            same = np.array_equal(drawn, np.asarray(tile(record, view, THUMB, truth)))
            assert same == (view == record.chosen)


def test_the_table_tells_the_records_numbers_in_the_order_of_its_head() -> None:
    records = made_up(CHOSEN_VIEWS)
    table = decision_table(Explained("episode 0", TASK, records))
    head, *rows = [re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in table.split("<tr>")[1:]]
    assert head[3:-1] == [f"weight, heat, {camera} [%]" for camera in records[0].views]
    for step, (row, record) in enumerate(zip(rows, records, strict=True)):
        pairs = zip(record.weights, record.support, strict=True)
        assert row[0] == f"{step + 1}"
        assert row[1] == decision_text(record)
        assert row[2] == list(record.views)[record.chosen]
        assert row[3:-1] == [f"{100 * weight:.0f}, {100 * support:.0f}" for weight, support in pairs]
        assert row[-1] == f"{100 * record.memory:.1f}"


def test_facts_tell_medians_and_the_largest_distance() -> None:
    records = made_up([0, 0, 1, 2, 2])
    truth = np.stack([one.action for one in records])
    truth[:, 0] += np.array([11, 2, 97, 5, 31]) / 1000
    half = np.radians([7, 23, 3, 61, 41]) / 2
    truth[:, 3], truth[:, 5] = np.cos(half), np.sin(half)
    truth[:2, 7] = 0
    told = facts(Explained("episode 0", TASK, records, truth))
    assert "acting view changes 2 times (front to side at 3, side to wrist at 4)" in told
    assert "distance to the true pose: median 11 mm, largest 97 mm" in told
    assert "rotation: median 23 degrees off" in told
    assert "gripper right in 3 of 5" in told
