"""Seeing inside a policy: ``histmv explain``."""
