"""Every file of conf/sweep and conf/variation has its own name and composes."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from pipeline.configuration import STAGES, build_options, build_stages, drop_replaced_fields
from pipeline.errors import BadInput
from pipeline.report.names import AXIS_TITLES
from pipeline.report.published import ABLATIONS

CONF = Path(__file__).parents[1] / "conf"
SWEEPS = sorted(path.stem for path in (CONF / "sweep").glob("*.yaml"))
PAPER = ("correspondence", "clusters", "pca_dim", "per_cluster", "timesteps", "theta")  # the Makefile's
VARIATIONS = sorted(path.stem for path in (CONF / "variation").glob("*.yaml"))


def composed(*overrides: str) -> dict:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(compose("config", overrides=list(overrides)), resolve=True)


def grid(name: str) -> dict[str, str]:
    return OmegaConf.load(CONF / "sweep" / f"{name}.yaml").hydra.sweeper.params


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_names_itself_and_draws_no_pictures(name):
    config = composed(f"sweep={name}")
    assert (config["overlays"], config["gallery"], config["sweep"]) == (False, 0, name)
    build_stages(config)


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_sweeps_run_its_method_on_ground_truth_boxes(name):
    config = composed(f"sweep={name}")
    assert config["method"] == ("dzop" if name == "correspondence" else "dzop_paper")
    assert config["detect"]["_target_"].endswith("GtBbox")
    asked = composed(f"sweep={name}", "detect=json", "method=zs6d", "variation=oracle_mask")
    assert (asked["method"], asked["detect"]["_target_"].split(".")[-1]) == ("zs6d", "Json")
    assert composed(f"sweep={name}", "variation=oracle_mask")["detect"]["_target_"].endswith("GtMask")


@pytest.mark.parametrize("name", ["hook", "input_size", "layers", "noise", "template_layer", "timesteps"])
def test_sweeps_over_features_do_not_use_a_head_trained_on_others(name):
    assert composed(f"sweep={name}")["fuse"]["_target_"].endswith("Pca")


@pytest.mark.parametrize(("method", "name"), [
    ("dzop_paper", "no_coprojection"), ("dzop_paper", "no_clusters"), ("dzop_paper", "oracle_correspondences"),
    ("zs6d", "oracle_template"), ("foundpose", "oracle_template"),
])  # fmt: skip
def test_a_variation_takes_the_fields_of_what_it_replaces_with_it(method, name):
    config = composed(f"method={method}", f"variation={name}")
    build_stages(config)
    kept, recorded = drop_replaced_fields(config), build_options(config).config
    assert kept != config
    assert {stage: set(kept[stage]) for stage in STAGES} == {stage: set(recorded[stage]) for stage in STAGES}


@pytest.mark.parametrize("replaced", ["solve=epnp", "choose=inliers"])
def test_a_variant_chosen_by_the_user_loses_the_methods_fields_for_another_one(replaced):
    stages = build_stages(composed("method=dzop_x", replaced))
    stage, name = replaced.split("=")
    assert getattr(stages, stage).kind == f"{stage}.{name}"


def test_a_wrong_field_of_the_methods_own_variant_stays_an_error():
    with pytest.raises(BadInput, match=r"solve.refit: found an unknown field"):
        build_stages(composed("method=dzop_x", "+solve.refit=2.0"))


def test_other_fields_that_a_variant_lacks_stay_an_error():
    config = composed("method=dzop_paper", "variation=no_clusters", "+cluster.seeds=3")
    with pytest.raises(BadInput, match=r"cluster.seeds: found an unknown field"):
        build_stages(config)


@pytest.mark.parametrize("axis", ABLATIONS)
def test_sweeps_use_the_papers_points(axis):
    points = {str(x) for x, _ in ABLATIONS[axis]}
    swept = next(grid(name)[axis] for name in SWEEPS if axis in grid(name))
    assert set(str(swept).split(",")) == points


@pytest.mark.parametrize("name", VARIATIONS)
def test_a_variation_names_itself_and_changes_only_its_stages(name):
    plain, config = composed(), composed(f"variation={name}")
    assert config["variation"] == name
    expected = {
        "none": set(),
        "no_coprojection": {"fuse", "correspond"},
        "no_clusters": {"correspond"},  # the default method has none
        "no_subpixel": {"correspond"},
        "oracle_mask": set(),
        "oracle_choice": {"choose"},
        "oracle_template": {"match"},
        "oracle_correspondences": {"match", "correspond", "refine", "second_look"},
    }[name]
    assert {key for key in plain if plain[key] != config[key]} - {"variation"} == expected


def test_the_papers_stages_lose_their_clusters_in_a_variation():
    assert composed("method=dzop")["cluster"]["_target_"].endswith("KMeans")
    assert composed("method=dzop", "variation=no_clusters")["cluster"]["_target_"].endswith("One")


def test_the_command_line_overrides_a_variation():
    assert composed("variation=no_subpixel", "correspond.kernel=5")["correspond"]["kernel"] == 5
    assert composed("variation=oracle_mask", "detect=gt_bbox")["detect"]["_target_"].endswith("GtBbox")


def test_every_swept_axis_has_a_title():
    axes = {key for name in SWEEPS for key in grid(name)} - {"variation", "evaluate.theta_max", "method"}
    assert axes <= set(AXIS_TITLES)
