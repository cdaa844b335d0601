"""Procedural objects and scenes in BOP format: demo and tests need no download and have exact ground truth."""
