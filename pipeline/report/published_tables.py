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


def published_notes() -> list[str]:
    """What a reader must know to compare the paper's figures with one another."""
    ours = next(method for method in published.METHODS if method.name == "DZOP")
    bars = {d: sum(by_object["DZOP"].values()) / len(by_object["DZOP"]) for d, by_object in published.OBJECTS.items()}
    compared = ", ".join(f"{bars[d]:.3f} on {name} (AR {ours.ar[d]:.3f})" for d, name in published.DATASETS.items())
    full, swept = published.CORRESPONDENCE[-1].ar, dict(published.ABLATIONS["cluster.count"])[200]
    return [
        f"The paper's bars of single objects are not its AR: their means are {compared}; on LM-O and T-LESS these are "
        "its curve's points at theta = 0.5. So they are drawn on axes of their own.",
        f"The paper states two figures for one configuration on LM-O: {full:.3f} in the table of correspondence "
        f"estimation, {swept:.4f} in its ablations. A detector's masks are behind its table of methods, ground-truth "
        "boxes behind its ablations.",
    ]


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
