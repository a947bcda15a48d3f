"""Large datasets in pieces: ``histmv keyframe-many``."""
