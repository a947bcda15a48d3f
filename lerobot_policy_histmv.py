"""The module that LeRobot imports to find HistMV: its name must equal the distribution's."""

from lerobot_histmv import _plugin  # noqa: F401
