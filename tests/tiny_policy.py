"""The tiny network as a LeRobot policy, with episodes to feed it: see ``tiny_scene`` for the world."""

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from tiny_scene import SEEN, SIZE, cameras_around, noise_images, tiny_network

from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.model.augment import AugmentConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

CAMERAS = ["front", "wrist"]
STATE_SIZE = 14
TASK = "pick up the red cube"
STILL = AugmentConfig(yaw=0.0, shift=0.0, pixels=0, brightness=0.0, contrast=0.0, lost_view=0.0, card=0.0)
"""No augmentation."""


def policy_features(cameras: list[str]) -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """Input and output features as LeRobot derives them from a dataset."""
    shapes = {keys.STATE: STATE_SIZE, keys.INTRINSICS: 4 * len(cameras), keys.EXTRINSICS: 12 * len(cameras)}
    inputs = {key: PolicyFeature(FeatureType.STATE, (count,)) for key, count in shapes.items()}
    for camera in cameras:
        inputs[keys.rgb_key(camera)] = PolicyFeature(FeatureType.VISUAL, (3, *SIZE))
        inputs[keys.depth_key(camera)] = PolicyFeature(FeatureType.VISUAL, (1, *SIZE))
    return inputs, {keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(keys.POSE_NAMES),))}


def tiny_config(cameras: list[str] = CAMERAS, past_steps: int = 2, **changes: Any) -> HistMVConfig:
    """Configuration of the tiny network for ``cameras``; ``changes`` replace its other fields."""
    inputs, outputs = policy_features(cameras)
    settings = {"network": tiny_network(past_steps), "augment": STILL, "instructions": {TASK: [TASK]}} | changes
    return HistMVConfig(
        device="cpu",
        push_to_hub=False,
        cameras=list(cameras),
        input_features=inputs,
        output_features=outputs,
        **settings,
    )


def tiny_policy(config: HistMVConfig | None = None, seed: int = 0, dataset_meta: Any = None) -> HistMVPolicy:
    """A seeded policy in evaluation mode."""
    torch.manual_seed(seed)
    return HistMVPolicy(config or tiny_config(), dataset_meta=dataset_meta).eval()


def episode(steps: int, seed: int = 0, cameras: list[str] = CAMERAS) -> dict[str, torch.Tensor]:
    """Rows (steps, ...) of one keyframed episode, as LeRobot hands them out: depth in millimetres, float32."""
    generator = torch.Generator().manual_seed(seed)
    rgb, depth = noise_images(steps, len(cameras), generator)
    intrinsics, extrinsics = (values.flatten().expand(steps, -1) for values in cameras_around(len(cameras)))
    poses = torch.randn(2, steps, 7, generator=generator)
    positions = SEEN + 0.1 * poses[..., :3]
    quaternions = torch.nn.functional.normalize(poses[..., 3:].abs(), dim=-1)
    grippers = torch.randint(2, (2, steps, 1), generator=generator).float()
    state, action = torch.cat([positions, quaternions, grippers], dim=-1)
    rows = {
        keys.STATE: torch.cat([state, torch.zeros(steps, STATE_SIZE - state.shape[1])], dim=1),
        keys.ACTION: action,
        keys.INTRINSICS: intrinsics.clone(),
        keys.EXTRINSICS: extrinsics.clone(),
    }
    for k, camera in enumerate(cameras):
        rows |= {keys.rgb_key(camera): rgb[:, k], keys.depth_key(camera): (1000 * depth[:, k, None]).round()}
    return rows


def window(rows: dict[str, torch.Tensor], end: int, past_steps: int = 2) -> dict[str, Any]:
    """What the loader gives for the drawn row ``end``: 2s + 1 rows, marked as padding outside of the episode.

    Of the state there are s more, before the others.
    """
    last = len(rows[keys.STATE]) - 1
    values: dict[str, Any] = {"task": [TASK]}
    for key in rows:
        first = end - (2 if key == keys.STATE else 1) * past_steps
        wanted = torch.arange(first, end + past_steps + 1)
        values[key] = rows[key][wanted.clamp(0, last)][None]
        values[f"{key}_is_pad"] = ((wanted < 0) | (wanted > last))[None]
    return values


def stack(batches: list[dict[str, Any]]) -> dict[str, Any]:
    """Several batches as one."""
    tensors = {key: torch.cat([batch[key] for batch in batches]) for key in batches[0] if key != "task"}
    return tensors | {"task": [sentence for batch in batches for sentence in batch["task"]]}


def observation(rows: dict[str, torch.Tensor], step: int, task: str = TASK) -> dict[str, Any]:
    """One row as a batch of one environment: no target, no window."""
    return {key: values[step : step + 1] for key, values in rows.items() if key != keys.ACTION} | {"task": [task]}
