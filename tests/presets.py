"""Stages that tests start from; change fields with ``dataclasses.replace``."""

from dataclasses import replace

from benchmarks.presets import PAPER
from pipeline.stages.cluster.one import One
from pipeline.stages.extract.hog import Hog
from pipeline.stages.fuse.concat import Concat
from pipeline.stages.render.raycast import Raycast

QUICK = replace(
    PAPER,
    render=Raycast(count=24, size=128),
    extract=Hog(),
    fuse=Concat(layers=(8,)),
    cluster=One(),
)
"""PAPER with few small templates and HOG features: a pose in a fraction of a second."""
