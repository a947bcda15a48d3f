"""Registers HistMV with LeRobot: policy ``histmv``, environment ``ur5``, their processor steps and the fast reader.

LeRobot imports this (through the module ``lerobot_policy_histmv``) at the start of each of its commands; a failing
import is only logged there, so nothing here may be optional. Neither mujoco nor CLIP is imported.
"""

from lerobot_histmv import configuration_histmv, processor_histmv
from lerobot_histmv.data.hook import install_hook
from lerobot_histmv.envs import configuration_ur5, processor_ur5

__all__ = ["configuration_histmv", "configuration_ur5", "processor_histmv", "processor_ur5"]

install_hook()
