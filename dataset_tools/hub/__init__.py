"""The Hugging Face Hub: cards, uploads, ``histmv push``."""
