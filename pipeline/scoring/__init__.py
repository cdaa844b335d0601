"""Poses, annotated dataset -> errors per estimate and correctness per instance, by BOP's rules for localisation.

For each target, the ``inst_count`` best-scored estimates are compared with the ``inst_count`` most visible annotated
instances. Estimates of images or objects that are not targets are ignored.
"""

from pipeline.scoring.identity import dataset_id, truth_digest
from pipeline.scoring.scorer import SCORES_VERSION, VSD_DELTA_MM, Scorer, ScoringResult

__all__ = ["SCORES_VERSION", "VSD_DELTA_MM", "Scorer", "ScoringResult", "dataset_id", "truth_digest"]
