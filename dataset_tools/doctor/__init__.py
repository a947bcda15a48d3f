"""What is wrong with a dataset: ``histmv doctor``."""
