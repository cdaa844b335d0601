"""Random schedules of processes and faults: no wrong number is read, and no wrong entry is completed."""

from pathlib import Path

import pytest

import pipeline.store.journal
from pipeline.store import LocalStoreConfig, Store
from tests.store.schedule import Schedule


def run_schedules(connect, seeds: int, steps: int, record_property, name: str, **options) -> None:
    schedules = [Schedule(lambda seed=seed: connect(seed), seed, **options) for seed in range(seeds)]
    for schedule in schedules:
        schedule.run(steps // seeds)
    counts = sum((schedule.counts for schedule in schedules), start=type(schedules[0].counts)())
    taken = sum(schedule.steps for schedule in schedules)
    wrong = [line for schedule in schedules for line in schedule.wrong]
    found = ", ".join(f"{number} {what}" for what, number in sorted(counts.items()))
    record_property("summary", f"{name}: {taken} steps ({found}): {len(wrong)} wrong reads or completes")
    assert wrong == []


SHORT_AND_LONG = [80, pytest.param(2400, marks=pytest.mark.faults)]


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("steps", SHORT_AND_LONG)
@pytest.mark.parametrize("locks", [True, False], ids=["flock", "flock does nothing"])
def test_no_schedule_on_disk_reads_or_completes_a_wrong_entry(tmp_path: Path, steps, locks, record_property):
    def connect(seed: int) -> Store:
        return Store(LocalStoreConfig(root=str(tmp_path / f"{seed}")))

    name = f"on disk, {'with locks' if locks else 'flock does nothing'}"
    run_schedules(connect, max(2, steps // 200), steps, record_property, name, locks=locks)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize(
    ("steps", "faults"),
    [(12, True), *(pytest.param(*long, marks=pytest.mark.faults) for long in ((2000, True), (600, False)))],
)
def test_no_schedule_on_s3_reads_or_completes_a_wrong_entry(s3, steps, faults, record_property, monkeypatch):
    if faults:  # rows of a killed writer are kept at once, and those of a running one too
        monkeypatch.setattr(pipeline.store.journal, "RUNNING_S", 0.0)

    def connect(seed: int) -> Store:
        return Store(s3.config(url=f"s3://dzop-tests/{seed}"))

    name = f"on S3, {'with' if faults else 'without'} faults"
    options = {"faults": faults, "separate": True}
    run_schedules(connect, max(1, steps // 200), steps, record_property, name, **options)
