"""Camera calibrations from YAML: ``histmv calibrate-attach``."""
