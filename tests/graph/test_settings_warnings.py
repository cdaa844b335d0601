"""Settings that another one leaves nothing to choose from."""

from dataclasses import replace

import pytest
from presets import QUICK

from pipeline.graph.checks import settings_warnings
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.correspond.cosine import Cosine as Corresponder
from pipeline.stages.correspond.salient import Salient
from pipeline.stages.match.cosine import Cosine
from pipeline.stages.match.masked_cosine import MaskedCosine
from pipeline.stages.render.raycast import Raycast


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"match": Cosine(top_k=30)},
            "match.top_k 30 is more than the 24 templates of an object: all of them are kept",
        ),
        ({"match": MaskedCosine(top_k=25)}, "match.top_k 25 is more than the 24 templates"),
        ({"match": Cosine(top_k=24)}, ""),
        ({"render": Raycast(count=3, inplane=2), "match": Cosine(top_k=7)}, "more than the 6 templates of an object"),
        ({"correspond": Corresponder(per_cluster=5)}, "correspond.per_cluster 5 has no effect with cluster=one"),
        ({"correspond": Corresponder()}, ""),
        ({"correspond": Salient()}, ""),
        ({"correspond": Corresponder(per_cluster=5), "cluster": KMeans()}, ""),
    ],
)
def test_settings_that_another_one_leaves_nothing_to_choose_from_are_said(changes, said):
    stages = replace(QUICK, **({"correspond": Salient()} | changes))
    warnings = settings_warnings(stages)
    assert len(warnings) == bool(said)
    assert all(said in warning for warning in warnings)
