"""From LeRobot's batch to packed windows: only real rows, metres, and tool positions of the past only."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_scene import SIZE, cameras_around, noise_images

from lerobot_histmv import keys
from lerobot_histmv.model import augment
from lerobot_histmv.model.augment import AugmentConfig, random_world_motion
from lerobot_histmv.model.cameras import project
from lerobot_histmv.windows import Window, causal_heat, look_back, read_window

B, T, CAMERAS = 3, 9, ["front", "wrist"]
K, S = len(CAMERAS), 4
EPISODES = ((0, 7), (2, 7), (4, 5))
"""Which of the nine rows around each drawn row, the fifth, lie in its episode."""

STILL = AugmentConfig(yaw=0.0, shift=0.0, pixels=0, brightness=0.0, contrast=0.0, lost_view=0.0, card=0.0)


def window_batch() -> dict[str, Any]:
    """Nine rows around each of three drawn rows."""
    generator = torch.Generator().manual_seed(0)
    rgb, depth = (v.unflatten(0, (B, T)) for v in noise_images(B * T, K, generator))
    intrinsics, extrinsics = (v.flatten().repeat(B, T, 1) for v in cameras_around(K))
    pose = torch.randn(2, B, T, 8, generator=generator)
    pose[..., 3:7] = torch.nn.functional.normalize(pose[..., 3:7], dim=-1)
    batch = {
        keys.STATE: torch.cat([pose[0], torch.zeros(B, T, 6)], dim=-1),
        keys.ACTION: pose[1],
        keys.INTRINSICS: intrinsics,
        keys.EXTRINSICS: extrinsics,
        f"{keys.STATE}_is_pad": torch.tensor([[not a <= i < b for i in range(T)] for a, b in EPISODES]),
    }
    for k, camera in enumerate(CAMERAS):
        batch |= {keys.rgb_key(camera): rgb[:, :, k], keys.depth_key(camera): 1000 * depth[:, :, k, None]}
    return batch


def test_only_real_rows_are_kept_in_order() -> None:
    batch = window_batch()
    window = read_window(batch, CAMERAS)
    assert window.real.tolist() == [[first <= t < last for t in range(T)] for first, last in EPISODES]
    rows = [(b, t) for b in range(B) for t in range(*EPISODES[b])]
    assert len(window.tool) == len(rows) == window.real.sum()
    for n, (b, t) in enumerate(rows):
        assert window.tool[n, -1].equal(batch[keys.STATE][b, t, :3])
        assert window.heat[n, -1] == 1
        torch.testing.assert_close(window.turn[n], batch[keys.STATE][b, t, 3:7])
        assert window.opening[n] == batch[keys.STATE][b, t, 7]
        assert window.action[n].equal(batch[keys.ACTION][b, t])
        for k, camera in enumerate(CAMERAS):
            assert window.rgb[n, k].equal(batch[keys.rgb_key(camera)][b, t])
            torch.testing.assert_close(window.depth[n, k], batch[keys.depth_key(camera)][b, t, 0] / 1000)


def neighbourhoods(past_steps: int, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows around each row of an episode, and which of them it has."""
    rows = torch.arange(length)[:, None] + torch.arange(-past_steps, past_steps + 1)
    return rows, (rows >= 0) & (rows < length)


LENGTHS = [1, 2, 3, 7, 13]


@pytest.mark.parametrize("past_steps", [0, 1, 2, 5])
@pytest.mark.parametrize("length", LENGTHS)
def test_every_row_of_an_episode_counts_once(past_steps: int, length: int) -> None:
    """Each row is drawn once per epoch; a draw's loss is a plain sum, so the shares of a row must add up to 1."""
    rows, exist = neighbourhoods(past_steps, length)
    lookback, shares = look_back(exist)
    decided = rows[exist][lookback.decided]
    torch.testing.assert_close(torch.zeros(length).index_add(0, decided, shares), torch.ones(length))


@pytest.mark.parametrize("past_steps", [0, 1, 2, 5])
@pytest.mark.parametrize("length", LENGTHS)
def test_every_decision_sees_its_whole_history_as_acting_does(past_steps: int, length: int) -> None:
    """The last s steps and itself, in order, from one episode; and every row that a draw can teach is taught by it."""
    rows, exist = neighbourhoods(past_steps, length)
    lookback, _ = look_back(exist)
    owner, absolute = exist.nonzero()[:, 0], rows[exist]
    taught = []
    for window, step in lookback.asked.nonzero():
        seen = lookback.rows[window, : step + 1][lookback.real[window, : step + 1]]
        (draw,) = owner[seen].unique().tolist()
        last = int(absolute[seen[-1]])
        assert absolute[seen].tolist() == list(range(max(0, last - past_steps), last + 1))
        taught.append((draw, last))
    whole = [(n, r) for n, r in zip(owner.tolist(), absolute.tolist(), strict=True) if r >= n or n < past_steps]
    assert sorted(taught) == sorted(whole), "all rows of a draw that shows the episode's start, else those from it on"


def test_padding_rows_have_no_influence_on_the_window() -> None:
    batch, spoiled = window_batch(), window_batch()
    padded = spoiled[f"{keys.STATE}_is_pad"]
    for key, values in spoiled.items():
        if not key.endswith("_is_pad"):
            values[padded] = torch.nan
    first, second = read_window(batch, CAMERAS), read_window(spoiled, CAMERAS)
    assert all(
        getattr(first, name).equal(getattr(second, name))
        for name in ("rgb", "depth", "intrinsics", "tool", "heat", "action")
    )


def test_calibration_is_unpacked_camera_by_camera() -> None:
    window = read_window(window_batch(), CAMERAS)
    intrinsics, extrinsics = cameras_around(K)
    assert window.intrinsics.equal(intrinsics.expand_as(window.intrinsics))
    assert window.extrinsics.equal(extrinsics.expand_as(window.extrinsics))


def test_single_observations_are_windows_of_one_step() -> None:
    batch = {key: values[:, S] for key, values in window_batch().items() if not key.endswith("_is_pad")}
    batch.pop(keys.ACTION)
    window = read_window(batch, CAMERAS)
    assert window.real.shape == (B, 1)
    assert window.real.all()
    assert window.rgb.shape == (B, K, 3, *SIZE)
    assert window.tool.equal(batch[keys.STATE][:, None, :3])
    assert window.heat.equal(torch.ones(B, 1))
    assert window.action is None


def test_views_come_in_the_policy_s_order() -> None:
    batch = window_batch()
    assert read_window(batch, CAMERAS[::-1]).rgb.equal(read_window(batch, CAMERAS).rgb.flip(1))


@pytest.mark.parametrize("key", [keys.rgb_key, keys.depth_key])
def test_missing_view_is_named(key: Any) -> None:
    batch = window_batch()
    del batch[key("wrist")]
    with pytest.raises(ValueError, match=rf"{key('wrist')}.*\['front', 'wrist'\]"):
        read_window(batch, CAMERAS)


def test_heat_is_1_now_decays_with_age_and_is_0_for_the_future() -> None:
    heat = causal_heat(torch.arange(-3, 4))
    assert heat[:3].eq(0).all()
    assert heat[3] == 1
    assert (heat[3:].diff() < 0).all()
    assert (heat[3:] > 0).all()


@pytest.mark.parametrize("more", [0, 2, S])
def test_each_row_sees_the_tool_now_and_in_the_last_s_steps_that_are_known_and_never_the_future(more: int) -> None:
    """With s more states than images, as training reads them, every row knows all of its last s steps."""
    batch, padded = window_batch(), f"{keys.STATE}_is_pad"
    earlier = torch.randn(B, more, 14, generator=torch.Generator().manual_seed(1))
    batch[keys.STATE] = states = torch.cat([earlier, batch[keys.STATE]], dim=1)
    before = batch[padded][:, :1].expand(-1, more).clone()
    before[:, : more // 2] = True  # the first row's episode starts before the images, but not with the states
    batch[padded] = absent = torch.cat([before, batch[padded]], dim=1)
    seen = read_window(batch, CAMERAS).observe(torch.zeros(B, 2))
    rows = [(b, t) for b in range(B) for t in range(*EPISODES[b])]
    for n, (b, t) in enumerate(rows):
        drawn = {tuple(seen.tool[n, p].tolist()): seen.heat[n, p].item() for p in range(S + 1) if seen.heat[n, p] > 0}
        last = [i for i in range(max(0, t + more - S), t + more + 1) if not absent[b, i]]
        ages = {tuple(states[b, i, :3].tolist()): t + more - i for i in last}
        assert set(drawn) == set(ages), "real steps up to now, and no other"
        torch.testing.assert_close(
            torch.tensor([drawn[tool] for tool in ages]),
            causal_heat(torch.tensor(list(ages.values()))),
            atol=1e-6,
            rtol=0,
        )


def test_each_row_gets_the_instruction_of_its_window() -> None:
    text = torch.arange(B, dtype=torch.float32)[:, None]
    seen = read_window(window_batch(), CAMERAS).observe(text)
    assert seen.text[:, 0].tolist() == [0] * 7 + [1] * 5 + [2]


def moved_window() -> tuple[Window, Window, torch.Tensor]:
    window = read_window(window_batch(), CAMERAS)
    torch.manual_seed(0)
    motion, turn = random_world_motion(B, AugmentConfig(yaw=1.0, shift=0.3), torch.tensor([0.4, 0.0, 0.3]))
    return window, window.moved(motion, turn), motion[window.real.nonzero()[:, 0]]


def test_world_motion_keeps_the_projections_of_tool_and_target() -> None:
    window, moved, _ = moved_window()
    for before, after in (
        (window.tool, moved.tool),
        (window.action[:, None, :3], moved.action[:, None, :3]),
    ):
        expected, z = project(before, window.intrinsics, window.extrinsics)
        found, z_moved = project(after, moved.intrinsics, moved.extrinsics)
        ahead = z > 0.05
        torch.testing.assert_close(z_moved, z, atol=1e-5, rtol=0)
        torch.testing.assert_close(found[ahead], expected[ahead], atol=5e-2, rtol=1e-4)


def test_world_motion_turns_tool_and_target_with_the_world_and_keeps_the_gripper() -> None:
    window, moved, motion = moved_window()
    for quaternions in ((window.action[:, 3:7], moved.action[:, 3:7]), (window.turn, moved.turn)):
        before, after = (Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix() for q in quaternions)
        torch.testing.assert_close(torch.from_numpy(after).float(), motion[:, :, :3] @ torch.from_numpy(before).float())
        torch.testing.assert_close(quaternions[1].norm(dim=1), torch.ones(len(moved.turn)))
    assert moved.action[:, 7].equal(window.action[:, 7])
    assert moved.rgb is window.rgb


def test_all_steps_of_a_window_move_together() -> None:
    window, moved, _ = moved_window()
    before, after = (torch.cdist(w.tool[:5, -1], w.tool[:5, -1]) for w in (window, moved))
    torch.testing.assert_close(after, before, atol=1e-4, rtol=0)


def test_distortion_changes_images_but_no_pose_and_not_the_original() -> None:
    window = read_window(window_batch(), CAMERAS)
    kept = window.rgb.clone(), window.depth.clone(), window.intrinsics.clone()
    distorted = window.distorted(AugmentConfig(depth_noise=0.01))
    assert not distorted.rgb.equal(window.rgb)
    assert not distorted.depth.equal(window.depth)
    assert distorted.tool is window.tool
    assert distorted.action is window.action
    assert all(now.equal(then) for now, then in zip((window.rgb, window.depth, window.intrinsics), kept, strict=True))


def test_a_lost_view_is_black_and_without_depth_in_all_steps_of_its_window() -> None:
    window = read_window(window_batch(), CAMERAS)
    owner, lost = window.real.nonzero()[:, 0], []
    torch.manual_seed(0)
    for _ in range(31):
        without = window.distorted(replace(STILL, lost_view=0.5))
        gone = (without.depth == 0).all(dim=-1).all(dim=-1)
        assert (without.rgb[gone] == 0).all()
        assert without.rgb[~gone].equal(window.rgb[~gone])
        assert without.depth[~gone].equal(window.depth[~gone])
        per_window = torch.stack([gone[owner == b][0] for b in range(B)])
        assert gone.equal(per_window[owner])
        assert (per_window.sum(dim=1) <= 1).all()
        lost.append(per_window)
    counts = torch.cat(lost).float().sum(dim=0)
    assert (counts > 0).all()
    assert 0.3 < counts.sum() / (31 * B) < 0.7


def test_the_only_camera_never_fails() -> None:
    """Else the policy would be taught where to go with nothing seen."""
    assert not augment.draw_views(101, 1, 1.0).any()
    assert augment.draw_views(101, 2, 1.0).sum(dim=1).eq(1).all()


def test_a_card_hides_one_rectangle_of_one_view_in_all_steps_of_its_window() -> None:
    window = read_window(window_batch(), CAMERAS)
    owner, shares = window.real.nonzero()[:, 0], []
    torch.manual_seed(0)
    for _ in range(31):
        covered = window.distorted(replace(STILL, card=0.5))
        hidden = (covered.rgb != window.rgb).any(dim=2)
        assert covered.depth[~hidden].equal(window.depth[~hidden])
        for b in range(B):
            rows = hidden[owner == b]
            assert rows.equal(rows[:1].expand_as(rows))
            views = rows[0].flatten(1).any(dim=1)
            assert views.sum() <= 1
            for view in views.nonzero()[:, 0]:
                y, x = rows[0, view].any(dim=1), rows[0, view].any(dim=0)
                assert rows[0, view].equal(y[:, None] & x)
                shares.append(rows[0, view].float().mean().item())
                depth = covered.depth[owner == b][:, view][rows[:, view]]
                assert depth.unique().numel() == 1
                assert depth[0] == 0 or 0.1 <= depth[0] <= 0.4
    assert 0.3 < len(shares) / (31 * B) < 0.7
    assert min(shares) < 0.2
    assert max(shares) > 0.7
