"""Identity of the targets and ground truth that scores refer to."""

from __future__ import annotations

from pipeline.items.scores import DatasetId
from pipeline.scoring.scorer import Scorer
from pipeline.spec import digest


def truth_digest(scorer: Scorer) -> str:
    """Digest of the targets and their annotations; scores are comparable only if it is equal."""
    content = [
        [t.scene_id, t.im_id, t.obj_id, t.inst_count, scorer.dataset.K(t.scene_id, t.im_id).tolist()]
        + [[gt.gt_id, gt.visib_fract, gt.T_cam_obj.tolist()] for gt in scorer.all_instances(t)]
        for t in scorer.targets
    ]
    return digest(content)


def dataset_id(scorer: Scorer) -> DatasetId:
    """The dataset and targets that are scored; ``targets`` counts instances."""
    data, objects = scorer.dataset, sorted({target.obj_id for target in scorer.targets})
    instances = sum(len(scorer.scored_instances(target)) for target in scorer.targets)
    return DatasetId(data.name, data.split, truth_digest(scorer), instances, len(scorer.images), tuple(objects))
