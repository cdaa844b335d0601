"""The benchmark's table: every system on every data set, the test seed among no other seeds in use."""

from pathlib import Path

from pipeline.embedded import benchmark


def test_every_system_has_a_row_on_every_data_set(monkeypatch, tmp_path):
    asked = []

    def run(choices, out: Path, cache: Path):
        asked.append((tuple(choices), out))
        return {"AR": 0.5, "template_error_geodesic_deg": 12.34}

    monkeypatch.setattr(benchmark, "_run", run)
    text = benchmark.benchmark(tmp_path, lmo=tmp_path / "lmo", detections=tmp_path / "found.json")
    assert len(asked) == 3 * len(benchmark.SYSTEMS)
    assert len({out for _, out in asked}) == len(asked)
    assert text.count("| HOG | - | 12.3 | 0.500 | - | - |") == 3
    assert f"dataset.seed={benchmark.TEST_SEED}" in asked[0][0]
