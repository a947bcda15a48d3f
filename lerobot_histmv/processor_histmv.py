"""Processors of the HistMV policy: what enters is checked, so that no wrong unit or order is trained on silently."""

import logging
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    EnvTransition,
    NormalizerProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    RenameObservationsProcessorStep,
    TransitionKey,
    UnnormalizerProcessorStep,
    policy_action_to_transition,
    transition_to_policy_action,
)
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from torch import Tensor

from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.geometry import UNIT_TOLERANCE

METRE_LIMIT = 20.0
"""Depth whose largest value lies below this [mm] was surely meant in metres."""


@dataclass
@ProcessorStepRegistry.register(name="histmv_check_input")
class CheckInputStep(ProcessorStep):
    """Refuse observations and targets that the policy would silently misread; depth becomes float32 millimetres.

    A camera without any depth is left out of the decisions it is missing in, with one warning, as long as another one
    sees something.

    Args:
        cameras: the policy's views.
    """

    cameras: list[str] = field(default_factory=list)
    _warned: set[str] = field(default_factory=set, init=False, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Check one transition.

        Raises:
            ValueError: a camera is missing, numbers are not finite, no view has valid depth, depth is in metres, a
                quaternion is not unit, or a gripper is not between 0 and 1.
        """
        new = transition.copy()
        observation = separate_calibration(dict(new[TransitionKey.OBSERVATION] or {}), len(self.cameras))
        seeing = {}
        for camera in self.cameras:
            for key in (keys.rgb_key(camera), keys.depth_key(camera)):
                if key not in observation:
                    raise ValueError(
                        f"observation lacks {key!r}; the policy was trained with the cameras {self.cameras}"
                    )
            key = keys.depth_key(camera)
            observation[key] = observation[key].to(torch.float32)
            seeing[camera] = check_depth(key, observation[key])
            check_colours(keys.rgb_key(camera), observation[keys.rgb_key(camera)])
        self._check_seeing(seeing)
        for key in (keys.STATE, keys.INTRINSICS, keys.EXTRINSICS):
            if key not in observation:
                raise ValueError(f"observation lacks {key!r}")
            if observation[key].ndim == 1:  # LeRobot's batching step knows state and images only
                observation[key] = observation[key][None]
            check_finite(key, observation[key])
        check_unit(keys.STATE, observation[keys.STATE])
        check_gripper(keys.STATE, observation[keys.STATE])
        check_calibration(observation[keys.INTRINSICS], observation[keys.EXTRINSICS], self.cameras)
        action = new.get(TransitionKey.ACTION)
        if isinstance(action, Tensor):
            check_finite(keys.ACTION, action)
            check_unit(keys.ACTION, action)
            check_gripper(keys.ACTION, action)
        new[TransitionKey.OBSERVATION] = observation
        return new

    def _check_seeing(self, seeing: dict[str, Bool[Tensor, "*steps"]]) -> None:
        if seeing and not torch.stack(list(seeing.values())).any(dim=0).all():
            raise ValueError(
                f"no camera of {self.cameras} has any valid depth (all 0) in some step; repair or replace the sensors"
            )
        for camera, sees in seeing.items():
            if camera not in self._warned and not sees.all():
                self._warned.add(camera)
                logging.warning("%s has images without any depth (all 0): decisions leave them out", camera)

    def get_config(self) -> dict[str, Any]:
        """What the checkpoint stores."""
        return {"cameras": self.cameras}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Features stay as they are."""
        return features


def separate_calibration(observation: dict[str, Any], cameras: int) -> dict[str, Any]:
    """The observation with the calibration taken out of the state's end, where a ``Robot`` has to put it.

    See ``keys.calibration_state_names``; ``keys.FROM_ROBOT`` then says so. An observation that has the calibration
    already, or too short a state, stays.
    """
    if keys.STATE not in observation or keys.INTRINSICS in observation:
        return observation
    state = observation[keys.STATE]
    rest = state.shape[-1] - 16 * cameras
    if rest < len(keys.POSE_NAMES):
        return observation
    parts = state.split([rest, 4 * cameras, 12 * cameras], dim=-1)
    told = {keys.FROM_ROBOT: torch.ones(state.shape[:-1], dtype=torch.bool, device=state.device)}
    return observation | told | dict(zip((keys.STATE, keys.INTRINSICS, keys.EXTRINSICS), parts, strict=True))


def check_finite(key: str, values: Tensor) -> None:
    """Raise ValueError if ``values`` holds NaN or infinity."""
    if not torch.isfinite(values).all():
        raise ValueError(f"{key} holds NaN or infinity; run `histmv doctor` on the dataset or check the sensor")


def check_depth(key: str, depth: Float[Tensor, "*steps 1 y x"]) -> Bool[Tensor, "*steps"]:
    """Which images have any valid depth [mm].

    Raises:
        ValueError: depth is not finite, or seems to be in metres.
    """
    smallest, largest = depth.flatten(-3).aminmax(dim=-1)  # NaN and infinity show in one of the two
    check_finite(key, smallest)
    check_finite(key, largest)
    sees = largest > 0
    if (largest[sees] < METRE_LIMIT).any():
        found = float(largest[sees].min())
        raise ValueError(
            f"{key} reaches at most {found:.3g}, which looks like metres; histmv expects millimetres (0 = invalid)"
        )
    return sees


def check_colours(key: str, colours: Tensor) -> None:
    """Raise ValueError if colours are not finite or exceed [0, 1]."""
    smallest, largest = colours.aminmax()
    check_finite(key, smallest)
    check_finite(key, largest)
    if largest > 1 + 1e-3:
        raise ValueError(f"{key} reaches {float(largest):.3g}, but colours must lie in [0, 1]; divide bytes by 255")


def check_calibration(intrinsics: Tensor, extrinsics: Tensor, cameras: list[str]) -> None:
    """Raise ValueError if the calibration is of another number of cameras, or no camera could have it."""
    for key, values, count in ((keys.INTRINSICS, intrinsics, 4), (keys.EXTRINSICS, extrinsics, 12)):
        if values.shape[-1] != count * len(cameras):
            raise ValueError(f"{key} holds {values.shape[-1]} numbers, but the cameras {cameras} need {count} each")
    focal = intrinsics.unflatten(-1, (-1, 4))[..., :2]
    if (focal <= 0).any():
        raise ValueError(
            f"{keys.INTRINSICS} holds the focal length {float(focal.min()):.3g}; it must be above 0 pixels"
        )
    rotation = extrinsics.unflatten(-1, (-1, 3, 4))[..., :3]
    away = rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    if (away.abs() > UNIT_TOLERANCE).any():
        raise ValueError(f"{keys.EXTRINSICS} holds a matrix that is no rotation; it must be the rows of T_world_cam")


def check_unit(key: str, vectors: Tensor) -> None:
    """Raise ValueError if the quaternions (components 3 to 6) of ``vectors`` are not unit."""
    norms = vectors[..., 3:7].norm(dim=-1).flatten()
    away = (norms - 1).abs()
    if (away > UNIT_TOLERANCE).any():
        raise ValueError(
            f"{key} holds a quaternion of norm {float(norms[away.argmax()]):.3g}; it must be unit, "
            "in the order w, x, y, z"
        )


def check_gripper(key: str, vectors: Tensor) -> None:
    """Raise ValueError if gripper openings or commands (component 7) are not those of ``keys.GRIPPER_NAME``."""
    grippers = vectors[..., 7]
    away = (grippers - 0.5).abs()
    if (away > 0.5 + keys.GRIPPER_SLACK).any():
        raise ValueError(
            f"{key} holds a {keys.GRIPPER_NAME} of {float(grippers.flatten()[away.argmax()]):.3g}; it must be from 0 "
            "(closed) to 1 (open): scale it by its closed and open ends"
        )


def make_histmv_pre_post_processors(
    config: HistMVConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """LeRobot's standard steps around ``CheckInputStep``; normalisation is the identity."""
    features = {**(config.input_features or {}), **(config.output_features or {})}
    before = PolicyProcessorPipeline[dict[str, Any], dict[str, Any]](
        steps=[
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            CheckInputStep(cameras=config.cameras),
            DeviceProcessorStep(device=str(config.device)),
            NormalizerProcessorStep(features=features, norm_map=config.normalization_mapping, stats=dataset_stats),
        ],
        name=POLICY_PREPROCESSOR_DEFAULT_NAME,
    )
    after = PolicyProcessorPipeline[PolicyAction, PolicyAction](
        steps=[
            UnnormalizerProcessorStep(
                features=config.output_features or {}, norm_map=config.normalization_mapping, stats=dataset_stats
            ),
            DeviceProcessorStep(device="cpu"),
        ],
        name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return before, after
