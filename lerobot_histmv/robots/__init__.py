"""Robots as LeRobot's own commands drive them: ``lerobot-rollout --robot.type=ur5_sim``."""
