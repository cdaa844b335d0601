"""A complete set of stages that benchmarks and tests start from; change fields with ``dataclasses.replace``."""

from dataclasses import replace

from pipeline.method import Stages
from pipeline.stages.choose.inliers import Inliers
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.correspond.cosine import Cosine as Corresponder
from pipeline.stages.crop.square import Square
from pipeline.stages.detect.gt_mask import GtMask
from pipeline.stages.extract.pixels import Pixels
from pipeline.stages.fuse.pca import Pca
from pipeline.stages.match.cosine import Cosine
from pipeline.stages.refine.none import NoRefinement
from pipeline.stages.render.raycast import Raycast
from pipeline.stages.solve.epnp import Epnp

PAPER = Stages(
    render=Raycast(),
    extract=Pixels(),
    crop=Square(),
    match=Cosine(),
    fuse=Pca(),
    cluster=KMeans(),
    correspond=Corresponder(),
    solve=Epnp(),
    choose=Inliers(),
    refine=NoRefinement(),
    detect=GtMask(),
)
"""The stages of method=dzop_sd, with pixels in place of the Stable Diffusion features."""

LETTER = replace(
    PAPER,
    crop=Square(padding_ratio=1.0),
    fuse=Pca(normalise=False, cells="all"),
    cluster=KMeans(planar="fundamental"),
    correspond=Corresponder(mutual=False, subtract_own_shift=False),
    solve=Epnp(iterations=100, confidence=0.99, refine=False),
)
"""Those of method=dzop_paper."""
