"""Procedural objects and scenes in BOP format, so that demo and tests have exact ground truth without a download."""
