"""Pictures of episodes: ``histmv inspect``."""
