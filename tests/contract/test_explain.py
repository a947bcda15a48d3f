"""``histmv explain``: its numbers are those of the policy that acted, its pictures show them where they belong."""

import base64
import dataclasses
import io
import re
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from fake_ur5 import INSTRUCTION, FakeUR5Config, write_checkpoint
from helpers import episodes
from matplotlib.axes import Axes
from PIL import Image
from tiny_dataset import write_dataset
from tiny_policy import TASK, episode, observation, tiny_config, tiny_policy, window
from tiny_scene import tiny_network

from dataset_tools.cli import main
from dataset_tools.eval_checkpoint import PolicySource
from dataset_tools.explain.attention import attention_weights, step_shares
from dataset_tools.explain.board import LARGEST, LINE, draw_board
from dataset_tools.explain.chapter import PANELS, facts, notes
from dataset_tools.explain.command import PAGE, ExplainConfig, ExplainedDataset, run
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.step_panels import draw_history, draw_poses
from dataset_tools.explain.view_panels import draw_information, draw_weights
from dataset_tools.explain.watch import Record, watched
from dataset_tools.page import draw_panels
from lerobot_histmv import keys
from lerobot_histmv.control import ControlConfig
from lerobot_histmv.geometry import project
from lerobot_histmv.model.config import HistoryConfig, ViewConfig
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.windows import read_window

STEPS, PAST_STEPS, LENGTHS = 7, 2, (3, 5)
REPO = "local/tiny"


CHOOSING = {
    "share of the heat": ViewConfig(),
    "weight x certainty": ViewConfig(decode="one"),
    "weight": ViewConfig(decode="one", act="weight"),
}


@pytest.fixture(scope="module", params=CHOOSING)
def policy(request: pytest.FixtureRequest) -> HistMVPolicy:
    network = tiny_network(past_steps=STEPS - 1, views=CHOOSING[request.param])
    return tiny_policy(tiny_config(network=network))


@pytest.fixture(scope="module")
def acted(policy: HistMVPolicy) -> tuple[torch.Tensor, list[Record]]:
    """Actions of one episode, and the records of them."""
    rows = episode(STEPS)
    policy.reset()
    with watched(policy) as records:
        actions = torch.cat([policy.select_action(observation(rows, step)) for step in range(STEPS)])
    return actions, records


def test_watching_changes_nothing_and_leaves_nothing(
    policy: HistMVPolicy, acted: tuple[torch.Tensor, list[Record]]
) -> None:
    policy.reset()
    actions = torch.cat([policy.select_action(observation(episode(STEPS), step)) for step in range(STEPS)])
    assert actions.equal(acted[0])
    assert "_decide" not in vars(policy)
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in policy.modules())


def test_a_decision_held_over_ticks_is_recorded_once(policy: HistMVPolicy) -> None:
    held = tiny_policy(dataclasses.replace(policy.config, control=ControlConfig(rate=20)))
    held.load_state_dict(policy.state_dict())
    batch = observation(episode(1), 0)
    policy.reset()
    with watched(held) as records:
        outputs = [held.select_action(batch) for _ in range(3)]
    (record,) = records
    np.testing.assert_allclose(record.action, policy.select_action(batch)[0], atol=1e-6)
    assert not torch.allclose(outputs[0][0, :3], torch.from_numpy(record.action[:3]), atol=1e-3)


def test_records_hold_what_the_policy_decided(policy: HistMVPolicy) -> None:
    rows = episode(STEPS)
    policy.reset()
    with watched(policy) as records:
        for step in range(STEPS):
            action = policy.select_action(observation(rows, step))
            record, decision = records[-1], policy.last_decision
            assert decision is not None
            np.testing.assert_array_equal(record.action, action[0])
            np.testing.assert_array_equal(record.weights, decision.weights[0])
            assert record.chosen == decision.view[0]
            together = policy.config.network.views.decode == "all"
            heat = decision.heat[0].numpy()
            np.testing.assert_allclose(record.heat[record.chosen], heat / heat.sum(), rtol=1e-4, atol=1e-9)
            workspace = policy.net.workspace
            limited = np.clip(record.targets[record.chosen], workspace.low.numpy(), workspace.high.numpy())
            assert together or record.action[:3] == pytest.approx(limited, abs=1e-6)
            assert (record.opening > 0.5) == bool(action[0, 7])
            np.testing.assert_allclose(record.tool, rows[keys.STATE][step, :3])


def test_shares_are_shares(acted: tuple[torch.Tensor, list[Record]]) -> None:
    for step, record in enumerate(acted[1]):
        assert record.weights.sum() == pytest.approx(1, abs=1e-6)
        assert record.chosen == record.scores.argmax()
        expected = {
            "share of the heat": record.support,
            "weight x certainty": record.weights * record.support,
            "weight": record.weights,
        }
        np.testing.assert_allclose(record.scores, expected[record.choosing.score])
        assert record.choosing.support == "certainty" or record.support.sum() == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(record.heat.sum(axis=(1, 2)), 1, atol=1e-5)
        assert record.attention.shape == (2, step + 1)
        np.testing.assert_allclose(record.attention.sum(axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(np.diagonal(record.information), 1)
        for index, view in enumerate(record.views.values()):
            assert view.depth is not None
            assert (record.heat[index][view.depth == 0] == 0).all()


def test_the_first_two_decisions_have_no_past(acted: tuple[torch.Tensor, list[Record]]) -> None:
    """The paper's rule: "where the current step is less than two, the strategy relies solely on the current"."""
    second, third = acted[1][1], acted[1][2]
    np.testing.assert_allclose(second.attention, [[0, 1]] * 2, atol=1e-6)
    assert second.memory == second.influence[0] == 0
    assert third.memory > 0
    assert (third.influence > 0).all()


def test_records_equal_the_whole_window(policy: HistMVPolicy, acted: tuple[torch.Tensor, list[Record]]) -> None:
    """Attention and information of an episode that is encoded at once, as training does it."""
    explained = Explained("episode", TASK, acted[1])
    whole = read_window(window(episode(STEPS), STEPS - 1, STEPS - 1), policy.config.cameras)
    seen = whole.observe(policy.net.semantics.text([TASK], torch.device("cpu")))
    shares = []
    hooks = [
        layer.register_forward_hook(
            lambda layer, inputs, _: shares.append(step_shares(attention_weights(layer, *inputs), STEPS)[0])
        )
        for layer in policy.net.history.layers
    ]
    with torch.no_grad():
        encoding, predicted, *_ = policy.net(seen, Lookback.over(whole.real[:, :STEPS]), "best")
        redundancy = policy.net.view_attention.redundancy(encoding.maps, encoding.weights)
    for hook in hooks:
        hook.remove()
    for layer, expected in enumerate(shares):
        found = explained.over_steps([one.attention[layer] for one in acted[1]])
        np.testing.assert_allclose(np.nan_to_num(found), expected, atol=1e-5)
    np.testing.assert_allclose(explained.actions[:, :3], predicted.position, atol=1e-5)
    own = np.einsum("ni,nij,nj->n", explained.weights, explained.information, explained.weights)
    np.testing.assert_allclose(own, redundancy, atol=1e-5)


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


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("run") / "pretrained_model")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data") / "tiny", REPO, LENGTHS, INSTRUCTION)


def assert_page(folder: Path, decisions: int) -> str:
    """Pictures and film are there, and the page holds all of them; returns its text."""
    names = {"decisions.png", "film.mp4", PAGE} | {f"episode_{panel.name}.png" for panel in PANELS}
    assert {path.name for path in folder.iterdir()} == names
    text = (folder / PAGE).read_text()
    embedded = re.findall(r'src="data:(\w+/\w+);base64,([^"]*)"', text)
    assert [kind for kind, _ in embedded] == ["video/mp4"] + ["image/png"] * (len(PANELS) + 1)
    assert base64.b64decode(embedded[0][1]) == (folder / "film.mp4").read_bytes()
    for _, data in embedded[1:]:
        assert Image.open(io.BytesIO(base64.b64decode(data, validate=True))).width > 400
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    assert text.count("<tr>") == decisions + 1
    with av.open(str(folder / "film.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) >= 20 * decisions
    return text


def test_an_episode_of_a_dataset_is_explained(
    checkpoint: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    flags = [f"--policy.path={checkpoint}", f"--dataset.repo_id={REPO}", f"--dataset.root={dataset}", "--episode=1"]
    main(["explain", *flags, f"--output={output}"])
    text = assert_page(output, LENGTHS[1])
    assert f"Episode 1: “{INSTRUCTION}”" in text
    assert "distance to the true pose" in text
    assert str(output / PAGE) in capsys.readouterr().out.replace("\n", "")
    with pytest.raises(SystemExit):
        main(["explain", *flags, f"--output={output}"])
    assert "--overwrite=true" in capsys.readouterr().err


def test_a_rollout_is_explained(checkpoint: Path, tmp_path: Path) -> None:
    run(ExplainConfig(policy=PolicySource(str(checkpoint)), env=FakeUR5Config(), seed=200_001, output=tmp_path / "out"))
    text = (tmp_path / "out" / PAGE).read_text()
    assert "Scene 200001" in text
    assert re.search(r"success|failed: ", text)
    assert_page(tmp_path / "out", text.count("<tr>") - 1)


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "explain needs one source"),
        ({"env": FakeUR5Config(), "dataset": ExplainedDataset(REPO)}, "explain needs one source"),
    ],
)
def test_exactly_one_source_is_needed(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ExplainConfig(**options)  # type: ignore[arg-type]


def test_what_cannot_be_explained_is_refused_in_words(checkpoint: Path, tmp_path: Path) -> None:
    policy, output = PolicySource(str(checkpoint)), tmp_path / "out"
    dense = ExplainedDataset("test/dense", episodes.write_picks(tmp_path / "dense", 1))
    with pytest.raises(ValueError, match="histmv keyframe"):
        run(ExplainConfig(policy=policy, dataset=dense, output=output))
    with pytest.raises(ValueError, match="2 tasks; name one of them"):
        run(ExplainConfig(policy=policy, env=FakeUR5Config("a,b"), output=output))
    assert not output.exists()


def test_targets_are_marked_where_the_pinhole_camera_sees_them(acted: tuple[torch.Tensor, list[Record]]) -> None:
    from dataset_tools.explain.board import seen_target

    view = acted[1][0].views["wrist"]
    assert view.intrinsics is not None
    assert view.world_from_cam is not None
    point = view.world_from_cam @ np.array([0.1, 0.05, 0.5, 1.0])  # in the camera's frame, made a world point
    fx, fy, cx, cy = view.intrinsics
    assert seen_target(view, point) == pytest.approx([fx * 0.2 + cx, fy * 0.1 + cy], abs=1e-3)
    assert project(point[None], view.intrinsics, view.world_from_cam)[1][0] == pytest.approx(0.5, abs=1e-5)
