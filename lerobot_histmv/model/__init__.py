"""The network in pure torch: no LeRobot, no file access except the towers' own weights."""
