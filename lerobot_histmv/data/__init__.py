"""Reading keyframed datasets fast: decoded frames, memory-mapped and shared, behind LeRobot's own dataset class."""
