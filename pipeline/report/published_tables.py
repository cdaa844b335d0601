"""Tables of the paper's own results."""

from __future__ import annotations

from pipeline.report import published
from pipeline.report.table import Table


def published_tables() -> list[Table]:
    """The paper's tables: methods, correspondence estimation, improvement over ZS6D."""
    return [_methods(), _correspondence(), _improvement()]


def published_methods_of(dataset: str) -> Table | None:
    """The paper's AR of every method on one dataset; None for datasets that are not in the paper."""
    if dataset not in published.DATASETS:
        return None
    rows = tuple((m.name, m.training, f"{m.ar[dataset]:.3f}") for m in published.METHODS)
    caption = f"AR of single-shot methods on {published.DATASETS[dataset]}, the paper's data and detections."
    return Table(f"published_{dataset}", caption, "published", ("method", "training", "AR"), rows)


def _methods() -> Table:
    head = ("method", "training", *published.DATASETS.values())
    rows = tuple((m.name, m.training, *(f"{m.ar[d]:.3f}" for d in published.DATASETS)) for m in published.METHODS)
    return Table("published_methods", "AR of single-shot methods.", "published", head, rows)


def _correspondence() -> Table:
    head = ("co-projection", "clusters", "sub-pixel", "AR", "s")
    yes = {True: "yes", False: "no"}
    rows = tuple(
        (yes[c.co_projection], yes[c.clusters], yes[c.sub_pixel], f"{c.ar:.3f}", f"{c.time_s:.2f}")
        for c in published.CORRESPONDENCE
    )
    return Table("published_correspondence", "Correspondence estimation, LM-O, RTX 4070.", "published", head, rows)


def _improvement() -> Table:
    head = ("dataset", "pose error", "Acc15", "AR")
    rows = tuple(
        (published.DATASETS[d], *(f"{v:+.2f} %" for v in values)) for d, values in published.IMPROVEMENT.items()
    )
    return Table("published_improvement", "Relative improvement of DZOP over ZS6D.", "published", head, rows)
