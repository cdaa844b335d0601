"""Run records with known scores, for tests of families, tables, figures and pages."""

import copy
from typing import Any

import numpy as np

from pipeline.items.errors import TemplateError
from pipeline.items.scores import DatasetId, Scores
from pipeline.report.run_records import RunRecord, run_id

CONFIG: dict[str, Any] = {
    "method": "dzop",
    "variation": "none",
    "extract": {"_target_": "pipeline.stages.extract.hog.Hog", "orientations": 8},
    "match": {"_target_": "pipeline.stages.match.cosine.Cosine", "layer": 2, "top_k": 1},
    "fuse": {"_target_": "pipeline.stages.fuse.pca.Pca", "layers": [2, 5, 8, 11], "dim": 64},
    "cluster": {"_target_": "pipeline.stages.cluster.kmeans.KMeans", "count": 200},
    "correspond": {"_target_": "pipeline.stages.correspond.cosine.Cosine", "per_cluster": 10, "kernel": 3},
    "solve": {"_target_": "pipeline.stages.solve.epnp.Epnp", "refine": True},
    "detect": {"_target_": "pipeline.stages.detect.gt_mask.GtMask", "visible": True},
    "evaluate": {"theta_max": 0.5},
    "dataset": {"_target_": "pipeline.synthetic.demo.DemoConfig", "name": "demo"},
    "out": "results",
}
EPNP_TO_POSELIB = {"_target_": "pipeline.stages.solve.poselib.PoseLib", "max_error": 2.0}


def changed(changes: dict[str, Any]) -> dict[str, Any]:
    """The configuration with dotted fields or whole groups replaced."""
    config = copy.deepcopy(CONFIG)
    for name, value in changes.items():
        node, *rest = name.split(".")
        if rest:
            config[node][rest[0]] = value
        else:
            config[node] = value
    return config


def toy_scores(level: float, *, instances: int = 24, vsd: bool = True, seed: int = 0) -> Scores:
    """Instances in images of three; an instance is found at all thresholds above its own difficulty."""
    rng = np.random.default_rng(seed)
    difficulty = rng.random((instances, 1)) * 1.2 - level
    thresholds = np.linspace(0.1, 1, 10)[None]
    mssd = difficulty < thresholds - 0.5
    surface = np.repeat(mssd[:, None], 10, axis=1) if vsd else None
    ids = [np.full(instances, 1), np.arange(instances) // 3, np.arange(instances) % 3 + 1, np.arange(instances) % 3]
    return Scores(*ids, rng.random(instances), mssd, difficulty < thresholds - 0.4, surface, "" if vsd else "no depth")


def toy_run(level: float = 0.5, *, at: int = 0, key: str = "k" * 64, method: str = "dzop-hog", name: str = "demo",
            vsd: bool = True, instances: int = 24, **changes: Any) -> RunRecord:  # fmt: skip
    """A finished run; ``changes``: fields of the configuration, dots written as two underscores."""
    config = changed({name.replace("__", "."): value for name, value in changes.items()})
    scores = toy_scores(level, vsd=vsd, instances=instances)
    templates = {i: TemplateError(20.0 - 10 * level, 15.0, 18.0) for i in scores.instances()}
    times = {"crop": 0.01, "extract": 0.05, "match": 0.002, "cluster": 0.03, "solve": 0.01}
    counts = {
        step: {"computed": 0, "reused": 900, "time_s": 0.0} for step in ("templates", "template features", "poses")
    }
    return RunRecord(
        id=run_id(config | {"of": f"{key} {method}"}),
        status="done",
        at=f"2026-01-01T00:00:{at:02d}",
        method=method,
        config=config,
        sweep="toy" if changes else "",
        detections="ground-truth masks (oracle)",
        answers=f"answers {level}",
        label={"extract": "hog", "match": config["match"]["_target_"].split(".")[-2]},
        dataset=DatasetId(name, "test", key, instances, (instances + 2) // 3, (1, 2, 3)),
        run=run_id({k: v for k, v in config.items() if k != "evaluate"} | {"of": f"{key} {method} {level}"}),
        folder="dzop-hog_demo-test/abc",
        csv="dzop-hog_demo-test.csv",
        estimates=instances - 1,
        counts=counts,
        times_s=times,
        bytes_per_object=1e7,
        failures=(("solve", "2 inliers, needs 6 <&>", 1),),
        scores=scores,
        templates=templates,
    )


def failed_run() -> RunRecord:
    config = changed({"cluster.count": -1})
    return RunRecord(
        id=run_id(config),
        status="failed",
        at="2026-01-01T00:01:00",
        method="dzop",
        config=config,
        label={},
        error="cluster.count: found -1, needs greater than or equal to 1",
        overrides=("cluster.count=-1", "sweep=clusters"),
        sweep="clusters",
    )
