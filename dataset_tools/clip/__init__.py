"""Frozen CLIP vectors as columns: ``histmv cache-clip``."""
