"""Where the files of a run are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pipeline.bop.results import results_name
from pipeline.graph import KEY_DIGITS, Context, Graph, ScoreNodes
from pipeline.options import Options
from pipeline.report.run_records import RunRecord, finished_run_record, run_id, run_record_path


@dataclass(eq=False)
class OutputFolder:
    """Paths of a run's files: ``<out>/<method>_<dataset>-<split>/<first digits of the run's key>/``.

    ``scores`` is None for a run that is not scored.
    """

    graph: Graph
    scores: ScoreNodes | None
    options: Options

    @property
    def context(self) -> Context:
        """The context of the run's graph."""
        return self.graph.context

    @property
    def out(self) -> Path:
        """Folder of the results of all runs."""
        return Path(self.options.out)

    @cached_property
    def csv_name(self) -> str:
        """File name of the BOP results."""
        data = self.context.dataset
        return results_name(self.options.file_name, data.name, data.split)

    @cached_property
    def path(self) -> Path:
        """The run's folder. It is named after the run's key, so its files never have to be overwritten."""
        return self.out / self.csv_name.removesuffix(".csv") / self.graph.poses.run_ref().key[:KEY_DIGITS]

    @property
    def detections(self) -> Path:
        """File of the detections that this run computed."""
        return self.path / "detections.json"

    @property
    def overlays(self) -> Path:
        """Folder of the overlays. Those drawn without the existing ground truth have a folder of their own."""
        annotated = all(self.context.dataset.has_ground_truth(t.scene_id) for t in self.context.targets)
        return self.path / ("overlays" if self.scores or not annotated else "overlays-unchecked")

    @property
    def record(self) -> Path:
        """File of the run's record."""
        return run_record_path(self.out, run_id(self.options.config))

    def earlier_record(self) -> RunRecord | None:
        """Record of an earlier, successful run with the same configuration and the same inputs."""
        record = finished_run_record(self.out, run_id(self.options.config))
        return record if record and self.scores and record.run == self.scores.ref.key else None

    def is_finished(self) -> bool:
        """Whether such a run exists and its csv is still there."""
        record = self.earlier_record()
        return record is not None and (self.out / record.folder / record.csv).exists()
