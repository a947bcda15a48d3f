"""Episodes of other formats: ``histmv convert``."""
