"""Run records -> sections of the report, one for each set of targets; results are never compared across sections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from pipeline.report import figures, tables, variation_tables
from pipeline.report.families import Family, base_of, families, is_oracle, scoring_settings
from pipeline.report.names import detections_text, run_name
from pipeline.report.plotting import Figure
from pipeline.report.run_records import RunRecord
from pipeline.report.run_statistics import ar_interval, ar_name, same_metric
from pipeline.report.table import Table

MAX_METHODS = 6
MAX_TIMED_RUNS = 12


@dataclass(eq=False)
class Section:
    """All finished jobs on one set of targets."""

    jobs: Sequence[RunRecord]
    title: str

    @cached_property
    def runs(self) -> list[RunRecord]:
        """One job of each group with the same scores, such as those that differ only in theta_max."""
        first: dict[tuple[str, str, str], RunRecord] = {}
        for job in sorted(self.jobs, key=lambda job: (not job.cases, bool(job.sweep))):
            first.setdefault((job.run, job.config.get("variation", "none"), str(scoring_settings(job))), job)
        return [job for job in self.jobs if job in first.values()]

    @cached_property
    def base(self) -> RunRecord:
        """The run that the others are compared with."""
        return base_of(self.runs)

    @cached_property
    def comparable(self) -> list[RunRecord]:
        """Runs scored like the base run: with the same metrics, on the same meshes."""
        how = scoring_settings(self.base)
        return [run for run in self.runs if same_metric(run, self.base) and scoring_settings(run) == how]

    @cached_property
    def best(self) -> RunRecord:
        """The run with the highest recall among those that use no ground truth."""
        candidates = [run for run in self.comparable if not is_oracle(run)] or [self.base]
        return max(candidates, key=lambda run: ar_interval(run.require_scores()).mean)

    @cached_property
    def dataset(self) -> str:
        """The dataset's name."""
        return self.base.dataset.name if self.base.dataset else ""

    @property
    def anchor(self) -> str:
        """Id of the section's HTML element."""
        return f"d-{self.base.dataset.key[:8]}" if self.base.dataset else "d"

    @property
    def folder(self) -> str:
        """Name of the folders of the section's figures and tables."""
        return f"{self.dataset}_{self.anchor.removeprefix('d-')}"

    @property
    def metric(self) -> str:
        """Name of the recall that runs are ordered by."""
        return ar_name(self.base.require_scores())

    @property
    def no_vsd(self) -> str:
        """Why VSD is not available; "" if it is."""
        return self.base.require_scores().no_vsd

    @property
    def notices(self) -> list[str]:
        """Notices of the feature extractors, such as that weights are random."""
        return list(dict.fromkeys(f"{run.method}: {run.notice}" for run in self.runs if run.notice))

    @property
    def machines(self) -> list[str]:
        """What computed the runs: versions, device and CPU, one line for each kind."""
        return sorted({machine for run in self.runs for machine in run.machines})

    @cached_property
    def methods(self) -> list[tuple[str, RunRecord]]:
        """One run per method, the base run first; of each other method the run with the fewest changed settings."""
        chosen = {self.base.method: self.base}
        for run in sorted(self.comparable, key=lambda run: len(self.name(run))):
            if not is_oracle(run):
                chosen.setdefault(run.method, run)
        return list(chosen.items())[:MAX_METHODS]

    @cached_property
    def families(self) -> list[Family]:
        """The ablations."""
        return families(self.comparable)

    def name(self, run: RunRecord) -> str:
        """The run's name relative to the base run."""
        return run_name(run, self.base)

    def headline(self) -> str:
        """The best run and its recall."""
        interval = ar_interval(self.best.require_scores())
        spread = f"95 % over images: {interval.low:.3f} to {interval.high:.3f}"
        on = detections_text([self.best])
        return f"{self.metric} {interval.mean:.3f} ({spread}) by {self.name(self.best)} on {on}"

    @property
    def detections(self) -> str:
        """What the detections of the runs are, with the mark of an oracle where they are ground truth."""
        return detections_text(self.runs)

    @property
    def flat(self) -> list[str]:
        """Notes on ablations whose setting changed no answer."""
        return [tables.flat_text(family) for family in self.families if family.is_flat]

    def figures(self) -> dict[str, list[Figure]]:
        """Figures by part of the page."""
        timed = self._timed_runs()
        return {
            "recalls": self._recall_figures(),
            "ablations": [figures.family_figure(family) for family in self.families],
            "times": [figures.times_figure(timed)] if timed else [],
        }

    def _recall_figures(self) -> list[Figure]:
        shown = dict(self.methods)
        if all(run.id != self.best.id for run in shown.values()):
            shown[f"{self.name(self.best)} (best)"] = self.best
        made = [
            *figures.objects_figures(shown, self.dataset),
            figures.theta_figure(shown, self.dataset),
            figures.thresholds_figure(self.base),
            figures.visibility_figure(self.base),
            figures.reliability_figure(self.base),
        ]
        return [figure for figure in made if figure is not None]

    def _timed_runs(self) -> dict[str, RunRecord]:
        """The runs whose times are drawn: one of each method and those with a part switched off."""
        method_of = {run.id: method for method, run in self.methods}
        shown = [
            run
            for run in self.runs
            if run.times_s and (run.id in method_of or run.config.get("variation", "none").startswith("no_"))
        ]
        by_name = {method_of.get(run.id, self.name(run)): run for run in shown}
        return dict(list(by_name.items())[:MAX_TIMED_RUNS])

    def tables(self) -> dict[str, list[Table]]:
        """Measured tables by part of the page."""
        by_part: dict[str, list[Table | None]] = {
            "runs": [tables.runs_table(self.runs, self.base), tables.templates_table(self.methods)],
            "ablations": [*map(tables.family_table, self.families)],
            "parts": [variation_tables.correspondence_table(self.runs), variation_tables.ladder_table(self.runs)],
            "methods": [tables.improvement_table(self.methods)],
            "times": [tables.times_table(self.methods), tables.counts_table(self.jobs, self.base)],
            "failures": [tables.failures_table(self.runs, self.base)],
        }
        return {part: [table for table in made if table is not None] for part, made in by_part.items()}

    def galleries(self) -> list[RunRecord]:
        """The two runs whose pictures are shown: if they have any, the base run and the best one."""
        return [run for run in dict.fromkeys([self.base, self.best, *self.runs]) if run.cases][:2]


def sections_of(runs: Sequence[RunRecord]) -> list[Section]:
    """Runs with scores, grouped by their targets; the section with the newest run is first."""
    by_key: dict[str, list[RunRecord]] = {}
    for run in runs:
        if run.dataset is not None and run.scores is not None:
            by_key.setdefault(run.dataset.key, []).append(run)
    names = [group[0].dataset.name for group in by_key.values() if group[0].dataset]
    sections = []
    for key, group in sorted(by_key.items(), key=lambda item: item[1][-1].at, reverse=True):
        data = group[0].dataset
        assert data is not None
        title = f"{data.name} {data.split}: {data.targets} targets, {data.images} images, {len(data.objects)} objects"
        sections.append(Section(group, f"{title} ({key[:6]})" if names.count(data.name) > 1 else title))
    return sections
