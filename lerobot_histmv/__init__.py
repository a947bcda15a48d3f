"""HistMV: a history-sensitive, multi-view keyframe policy for LeRobot, with its UR5e tasks."""

__version__ = "0.1.0"
