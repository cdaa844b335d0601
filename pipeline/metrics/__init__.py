"""Pose errors, recalls and their confidence intervals, as defined by bop_toolkit."""
