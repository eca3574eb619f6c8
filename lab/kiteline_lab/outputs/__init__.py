"""Output files: complete or absent, and folders with one writer."""
