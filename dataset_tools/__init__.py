"""From recorded episodes to keyframed LeRobot datasets: recording, keyframing, evaluation and the demo."""
