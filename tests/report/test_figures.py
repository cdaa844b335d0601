import warnings
from dataclasses import replace

import numpy as np
import pytest
from toy_runs import toy_run

from pipeline.report import figures
from pipeline.report.families import families
from pipeline.report.plotting import SIZE, Figure


def of_many_objects(count: int):
    row = toy_run(instances=2 * count)
    return replace(row, scores=replace(row.scores, obj_id=np.arange(2 * count) % count + 1))


def objects_of(figure: Figure) -> list[int]:
    return [int(label.get_text()) for label in figure.canvas.axes[-1].get_xticklabels()]


@pytest.mark.parametrize("runs", [1, 7])
def test_many_objects_are_split_into_figures_with_few_bars(runs):
    drawn = figures.objects_figures({str(n): of_many_objects(30) for n in range(runs)}, "tless")
    assert [obj_id for figure in drawn for obj_id in objects_of(figure)] == list(range(1, 31))
    for figure in drawn:
        assert len(objects_of(figure)) * max(runs, 2) <= figures.MAX_BARS
        assert figure.canvas.get_size_inches()[0] == SIZE[0]


def test_published_bars_have_axes_of_their_own_and_only_on_their_own_dataset():
    def figure(dataset):
        return figures.objects_figures({"run": toy_run()}, dataset)[0]

    assert len(figure("demo").canvas.axes) == 1
    for dataset, heights in (("lmo", 0.5371), ("ycbv", 0.9233), ("tless", 0.1830)):
        measured, below = figure(dataset).canvas.axes
        assert [bars.get_label() for bars in below.containers] == ["ZS6D", "DZOP"]
        assert below.containers[1][0].get_height() == heights
        assert all(bar.get_linestyle() == "--" for bars in below.containers for bar in bars)
        assert "published" in below.get_title(loc="left")
        assert "not AR" in below.get_title(loc="left")
        assert not {"ZS6D", "DZOP"} & {str(bars.get_label()) for bars in measured.containers}
        assert "their mean is not its AR" in figure(dataset).caption


def test_the_papers_curve_has_its_own_axes_if_the_paper_has_one():
    known, unknown = (
        figures.family_figure(families([toy_run(), toy_run(**change)])[0])
        for change in ({"cluster__count": 40}, {"match__top_k": 5})
    )
    measured, published = known.canvas.axes
    assert "published" in published.get_title(loc="left")
    assert all(line.get_markerfacecolor() == "white" for line in published.lines)
    assert all(line.get_linestyle() != "--" for line in measured.lines)
    assert len(unknown.canvas.axes) == 1


def test_a_metric_keeps_its_colour_if_vsd_is_missing():
    def colours(row):
        (axes,) = figures.thresholds_figure(row).canvas.axes
        return {line.get_label()[:4]: line.get_color() for line in axes.lines}

    assert colours(toy_run(vsd=False)).items() < colours(toy_run()).items()


def test_a_figure_contains_text_and_is_reproducible():
    first, second = (figures.theta_figure({"run": toy_run()}, "demo").svg() for _ in range(2))
    assert first == second
    assert ">published, LM-O<" in first.replace("</tspan>", "")
    assert "<metadata>" not in first


def test_long_names_leave_room_for_the_axes():
    long = "match.layer=8, " * 12 + "solve._target_=pipeline.stages.solve.poselib.PoseLib"
    rows = {long: toy_run(), long + " too": toy_run(0.3)}
    drawn = figures.times_figure(rows), figures.theta_figure(rows, "demo"), *figures.objects_figures(rows, "demo")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # matplotlib gives up its layout with a warning
        for figure in drawn:
            figure.canvas.draw_without_rendering()


def test_reliability_is_drawn_for_runs_whose_poses_have_a_confidence():
    assert figures.reliability_figure(toy_run()) is None
    pairs = tuple((0.9, k < 9) for k in range(10)) + tuple((0.3, k < 3) for k in range(10))
    drawn = figures.reliability_figure(replace(toy_run(), confidences=pairs))
    assert "AUC 0.81, calibration error 0.0%" in drawn.caption
    assert [text.get_text() for text in drawn.canvas.axes[0].texts] == ["10", "10"]
