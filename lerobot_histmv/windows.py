"""From LeRobot's batch dictionary to packed tensors: only real rows of each window are kept."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from lerobot_histmv import keys
from lerobot_histmv.model import augment
from lerobot_histmv.model.history import Lookback, pack
from lerobot_histmv.model.network import Observation
from lerobot_histmv.model.rotations import multiply_quaternions

MILLIMETRE = 1e-3
HEAT_DECAY = 0.6
"""Intensity of a tool position in the thermal map relative to the next newer one."""


def causal_heat(age: Tensor) -> Tensor:
    """Intensity of a tool position ``age`` steps ago; 0 for negative ages (the future)."""
    return torch.where(age >= 0, HEAT_DECAY ** age.clamp_min(0).float(), 0.0)


@dataclass
class Window:
    """The n real rows of b windows of t rows, packed in row-major order.

    Args:
        real: which rows are real; the others lie before an episode's start or after its end.
        rgb: colours in [0, 1].
        depth: distance along the optical axis [m], 0 where invalid.
        intrinsics: fx, fy, cx, cy [pixels].
        extrinsics: T_world_cam.
        tool: measured tool positions [m], the current one last.
        heat: their intensity, 1 now, less with age, 0 where there was none.
        turn: measured rotation of the tool, as a quaternion.
        opening: measured opening of the gripper, 1 open.
        action: target position [m], quaternion wxyz, gripper; absent at inference.
        clip: stored semantic vectors of the views, of the images as recorded; absent if the data hold none that fit.
    """

    real: Bool[Tensor, "b t"]
    rgb: Float[Tensor, "n k 3 y x"]
    depth: Float[Tensor, "n k y x"]
    intrinsics: Float[Tensor, "n k 4"]
    extrinsics: Float[Tensor, "n k 3 4"]
    tool: Float[Tensor, "n p 3"]
    heat: Float[Tensor, "n p"]
    turn: Float[Tensor, "n 4"]
    opening: Float[Tensor, " n"]
    action: Float[Tensor, "n 8"] | None
    clip: Float[Tensor, "n k g"] | None = None

    @property
    def target(self) -> Float[Tensor, "n 8"]:
        """Actions to learn from; ValueError for a batch of observations alone."""
        if self.action is None:
            raise ValueError(f"the batch lacks {keys.ACTION!r}, which training needs")
        return self.action

    def observe(self, text: Float[Tensor, "b c"]) -> Observation:
        """What the network sees, each window with its instruction."""
        seen = text[self.real.nonzero()[:, 0]]
        return Observation(
            rgb=self.rgb,
            depth=self.depth,
            intrinsics=self.intrinsics,
            extrinsics=self.extrinsics,
            tool=self.tool,
            heat=self.heat,
            turn=self.turn,
            opening=self.opening,
            text=seen,
            clip=self.clip,
        )

    def moved(self, motion: Float[Tensor, "b 3 4"], turn: Float[Tensor, "b 4"]) -> "Window":
        """The window after a rigid motion of the world, one per window; ``turn`` is its rotation as a quaternion."""
        owner = self.real.nonzero()[:, 0]
        each, turns = motion[owner], turn[owner]
        points = augment.move_points(each, torch.cat([self.tool, self.target[:, None, :3]], dim=1))
        rotated = multiply_quaternions(turns, self.target[:, 3:7])
        return replace(
            self,
            extrinsics=augment.move_cameras(each, self.extrinsics[:, None])[:, 0],
            tool=points[:, :-1],
            turn=multiply_quaternions(turns, self.turn),
            action=torch.cat([points[:, -1], rotated, self.target[:, 7:]], dim=-1),
        )

    def distorted(self, config: augment.AugmentConfig) -> "Window":
        """The window with shifted, recoloured images and noisy depth, and now and then with a view hidden or lost."""
        rgb = augment.jitter_colours(self.rgb, config)
        rgb, depth, intrinsics = augment.shift_pixels(rgb, self.depth, self.intrinsics, config.pixels)
        if config.depth_noise > 0:
            depth = augment.noisy_depth(depth, config.depth_noise)
        windows, views = len(self.real), depth.shape[1]
        owner = self.real.nonzero()[:, 0]
        if config.card > 0:
            size = (depth.shape[2], depth.shape[3])
            rgb, depth = augment.Cards.draw(windows, views, config.card, size).hide(rgb, depth, owner)
        if config.lost_view > 0:
            shown = ~augment.draw_views(windows, views, config.lost_view).to(depth.device)[owner]
            rgb, depth = rgb * shown[..., None, None, None], depth * shown[..., None, None]
        return replace(self, rgb=rgb, depth=depth, intrinsics=intrinsics)


def look_back(exist: Bool[Tensor, "b t"]) -> tuple[Lookback, Float[Tensor, " r"]]:
    """Spans of up to s + 1 steps for every row known to have its whole history in its window, and its loss's share.

    Where a window reaches beyond the episode's start, the first s + 1 rows are one span: causal attention shows each
    its own past. Any later row, and in other windows the drawn one and those after it, has its own, of itself and the s
    rows before it. Over an epoch, which draws every row once, the shares of a row sum to 1, however many windows show
    it.

    Args:
        exist: which of the rows of each window, from s before to s after the drawn one, lie in its episode.
    """
    past_steps = exist.shape[1] // 2
    span, column = torch.arange(past_steps + 1, device=exist.device), torch.arange(exist.shape[1], device=exist.device)
    before = (~exist).cumprod(dim=1).sum(dim=1)
    starts = before > 0  # the episode's first row is among them
    alone = exist & (column >= past_steps + torch.where(starts, before + 1, 0)[:, None])
    owner = torch.cat([starts.nonzero()[:, 0], alone.nonzero()[:, 0]])
    columns = torch.cat([before[starts], alone.nonzero()[:, 1] - past_steps])[:, None] + span
    real = exist[owner[:, None], columns]
    shared = (torch.arange(len(owner), device=exist.device) < starts.sum())[:, None]
    asked = real & (shared | (span == past_steps))
    # Of the first s rows each is asked for by the windows of all; any other one by its own and those of the s before.
    early = exist[owner].sum(dim=1)[:, None].clamp_max(past_steps)
    draws = torch.where(shared & (span < past_steps), early, past_steps + 1)
    shown = real.any(dim=0)  # a column that no span has would only cost attention
    rows, real, asked, draws = (each[:, shown] for each in (pack(exist)[owner[:, None], columns], real, asked, draws))
    return Lookback(rows, real, asked), 1 / draws[asked]


def past_tools(
    state: Float[Tensor, "b r c"], exist: Bool[Tensor, "b r"], rows: int
) -> tuple[Float[Tensor, "b q p 3"], Float[Tensor, "b q p"]]:
    """Tool positions [m] of the s steps before each of the last ``q = rows = 2s + 1`` rows and their own; their heat.

    Args:
        state: states that start with the tool position, of those rows and up to s earlier ones.
        exist: which of them lie in the episode.
        rows: how many rows want to know.
    """
    past_steps = rows // 2
    front = rows + past_steps - state.shape[1]
    tools = functional.pad(state[..., :3].masked_fill(~exist[..., None], 0), (0, 0, front, 0))
    known = functional.pad(exist, (front, 0)).unfold(1, past_steps + 1, 1)
    age = torch.arange(past_steps, -1, -1, device=state.device)
    return rearrange(tools.unfold(1, past_steps + 1, 1), "b q c p -> b q p c"), causal_heat(age) * known


def read_window(batch: dict[str, Any], cameras: list[str], stored_as: str | None = None) -> Window:
    """Pack a batch of neighbourhoods (training) or of single observations (inference).

    Args:
        batch: what LeRobot's loader or environment gives: 2s + 1 rows around each drawn row, or one row. States may
            have up to s more rows before them: without those, rows see no tool positions from before their window.
        cameras: views in the policy's order.
        stored_as: fingerprint of the CLIP vectors that may be taken from the batch; None for none.

    Raises:
        ValueError: a camera of the policy is missing in the batch.
    """
    wanted = [key(camera) for camera in cameras for key in (keys.rgb_key, keys.depth_key)]
    missing = [key for key in wanted if key not in batch]
    if missing:
        raise ValueError(f"observation lacks {missing}; the policy was made for the cameras {cameras}")
    state = batch[keys.STATE]
    real = torch.ones(len(state), 1, dtype=torch.bool, device=state.device)
    tools, heat = state[:, None, :3], torch.ones_like(state[:, :1])
    windowed = state.ndim == 3
    if windowed:
        exist, rows = ~batch[f"{keys.STATE}_is_pad"], batch[keys.INTRINSICS].shape[1]
        real = exist[:, -rows:]
        tools, heat = past_tools(state, exist, rows)
        tools, heat, state = tools[real], heat[real], state[:, -rows:][real]

    def pick(key: str) -> Tensor:
        return batch[key][real] if windowed else batch[key]

    depth = torch.stack([pick(keys.depth_key(camera)) for camera in cameras], dim=1)
    vectors = [keys.clip_key(stored_as, camera) for camera in cameras] if stored_as else []
    stored = bool(vectors) and all(key in batch for key in vectors)
    return Window(
        real=real,
        rgb=torch.stack([pick(keys.rgb_key(camera)) for camera in cameras], dim=1),
        depth=MILLIMETRE * rearrange(depth, "n k 1 y x -> n k y x"),
        intrinsics=rearrange(pick(keys.INTRINSICS), "n (k c) -> n k c", c=4),
        extrinsics=rearrange(pick(keys.EXTRINSICS), "n (k i j) -> n k i j", i=3, j=4),
        tool=tools,
        heat=heat,
        turn=functional.normalize(state[:, 3:7], dim=-1),
        opening=state[:, 7],
        action=pick(keys.ACTION) if batch.get(keys.ACTION) is not None else None,
        clip=torch.stack([pick(key) for key in vectors], dim=1) if stored else None,
    )
