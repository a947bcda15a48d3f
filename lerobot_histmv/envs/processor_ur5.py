"""Turns what LeRobot makes of the environment's observations into the dataset's names and shapes."""

from dataclasses import dataclass
from typing import Any

from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry

from lerobot_histmv import keys


@dataclass
@ProcessorStepRegistry.register(name="ur5_depth")
class UR5DepthProcessorStep(ObservationProcessorStep):
    """Moves ``observation.<camera>_depth`` (b, h, w, 1) to ``observation.images.<camera>_depth`` (b, 1, h, w), in mm.

    LeRobot's own conversion knows no depth images and passes them on, channel last, as float32.
    """

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The same observation, its depth images under their dataset keys."""
        renamed = {}
        for key, value in observation.items():
            name = key.removeprefix(keys.OBS_PREFIX)
            if name.endswith(keys.DEPTH_SUFFIX) and not key.startswith(keys.IMAGES_PREFIX):
                key, value = f"{keys.IMAGES_PREFIX}{name}", value.permute(0, 3, 1, 2).contiguous()
            renamed[key] = value
        return renamed

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        """The environment's config already speaks of the dataset's names."""
        return features
