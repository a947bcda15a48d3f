"""Configuration of the HistMV policy as LeRobot's ``--policy.type=histmv`` knows it."""

from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_histmv import keys
from lerobot_histmv.control import ControlConfig
from lerobot_histmv.model.augment import AugmentConfig
from lerobot_histmv.model.config import LossConfig, NetworkConfig

WHOLE_RUN = 10_000_000
"""LeRobot shrinks a schedule that is longer than the run to the run's length: this always means "the whole run"."""


def identity_normalization() -> dict[str, NormalizationMode]:
    """The policy scales its inputs itself: statistics of near-constant calibration or quaternions are meaningless."""
    return dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)


@PreTrainedConfig.register_subclass("histmv")
@dataclass
class HistMVConfig(PreTrainedConfig):
    """History-sensitive multi-view keyframe policy (Lu et al. 2024).

    Args:
        network: sizes and switches of the network.
        loss: weights and forms of the loss terms.
        augment: strengths of the augmentation.
        control: how a decision becomes outputs: whole macro steps, or the ticks of a control loop.
        cameras: views in the order of the calibration; read from the dataset when empty.
        instructions: recorded instruction -> its paraphrases, among which training draws; read from the dataset when
            empty.
        optimizer_lr: peak learning rate.
        optimizer_weight_decay: AdamW's weight decay.
        optimizer_grad_clip_norm: largest norm of the gradient.
        warmup_fraction: share of the run with rising learning rate; a cosine to ``final_lr_fraction`` follows.
        final_lr_fraction: last learning rate over the peak.
        normalization_mapping: LeRobot's normalisation; identity, see ``identity_normalization``.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    cameras: list[str] = field(default_factory=list)
    instructions: dict[str, list[str]] = field(default_factory=dict)
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-3
    optimizer_grad_clip_norm: float = 5.0
    warmup_fraction: float = 0.05
    final_lr_fraction: float = 0.02
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=identity_normalization)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs_steps = self.network.history.past_steps + 1
        if any(mode is not NormalizationMode.IDENTITY for mode in self.normalization_mapping.values()):
            raise ValueError(
                f"normalization_mapping={self.normalization_mapping}: histmv scales its inputs itself, use IDENTITY"
            )

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        """Read the cameras' order from the dataset and refuse one that the policy would silently misread.

        Raises:
            ValueError: calibration, depth or component names are missing, or differ from those of this configuration.
        """
        for key in (keys.ACTION, keys.STATE):
            found = list(features.get(key, {}).get("names") or [])[: len(keys.POSE_NAMES)]
            if found != list(keys.POSE_NAMES):
                raise ValueError(f"{key} of the dataset starts with {found}, but histmv needs {list(keys.POSE_NAMES)}")
        missing = [key for key in (keys.INTRINSICS, keys.EXTRINSICS) if key not in features]
        if missing:
            raise ValueError(
                f"dataset lacks the camera calibration {missing}; histmv lifts pixels to world points with it"
            )
        cameras = keys.cameras_of(features[keys.INTRINSICS]["names"] or [])
        for key, names in (
            (keys.INTRINSICS, keys.intrinsics_names(cameras)),
            (keys.EXTRINSICS, keys.extrinsics_names(cameras)),
        ):
            found = features[key]["names"]
            if not found or list(found) != names:
                raise ValueError(f"{key} has names {found}, but histmv needs {names or 'CAMERA.fx, CAMERA.fy, ...'}")
        if self.cameras and self.cameras != cameras:
            raise ValueError(f"policy.cameras={self.cameras} differ from the dataset's calibrated cameras {cameras}")
        self.cameras = cameras

    def _save_pretrained(self, save_directory: Path) -> None:
        """Write ``config.json``. A checkpoint holds trained weights: loading it must not fetch what they began with."""
        written, texture, semantics = copy(self), self.network.texture, self.network.semantics
        own = replace(semantics, clip_pretrained=None if semantics.trained else semantics.clip_pretrained)
        written.network = replace(self.network, texture=replace(texture, pretrained=False), semantics=own)
        super(HistMVConfig, written)._save_pretrained(save_directory)

    def validate_features(self) -> None:
        """Raise ValueError unless every calibrated camera has a colour and a depth image of one size."""
        if not self.cameras:
            raise ValueError(
                "policy.cameras is empty: name the calibrated cameras, or train on a dataset with calibration"
            )
        # Stored CLIP vectors spare training the towers; an environment gives none, and none are needed.
        for key in [key for key in self.input_features or {} if key.startswith(keys.CLIP_PREFIX)]:
            del self.input_features[key]
        inputs = self.input_features or {}
        wanted = [key(camera) for camera in self.cameras for key in (keys.rgb_key, keys.depth_key)]
        missing = [key for key in (*wanted, keys.STATE, keys.INTRINSICS, keys.EXTRINSICS) if key not in inputs]
        if missing:
            raise ValueError(f"histmv needs {missing}, which the data lacks; it has {sorted(inputs)}")
        sizes = {inputs[key].shape[1:] for key in wanted}
        if len(sizes) > 1:
            raise ValueError(f"all views must have one size, but the images have sizes {sorted(sizes)}")
        for key, count in ((keys.INTRINSICS, 4), (keys.EXTRINSICS, 12)):
            if inputs[key].shape != (count * len(self.cameras),):
                raise ValueError(
                    f"{key} has shape {inputs[key].shape}; {len(self.cameras)} cameras need {count} numbers each"
                )
        if self.action_feature is None or self.action_feature.shape != (len(keys.POSE_NAMES),):
            raise ValueError(f"action must have the {len(keys.POSE_NAMES)} components {list(keys.POSE_NAMES)}")

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of every view."""
        shape = next(f.shape for f in (self.input_features or {}).values() if f.type is FeatureType.VISUAL)
        return shape[1], shape[2]

    @property
    def observation_delta_indices(self) -> list[int]:
        """Steps from s before to s after the drawn one: what is learned of them, ``windows.look_back`` says."""
        return list(range(-self.network.history.past_steps, self.network.history.past_steps + 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """A target for every step."""
        return self.observation_delta_indices

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW."""
        return AdamWConfig(
            lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay, grad_clip_norm=self.optimizer_grad_clip_norm
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Linear warm-up and cosine decay over the whole run, however long it is."""
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=int(self.warmup_fraction * WHOLE_RUN),
            num_decay_steps=WHOLE_RUN,
            peak_lr=self.optimizer_lr,
            decay_lr=self.optimizer_lr * self.final_lr_fraction,
        )
