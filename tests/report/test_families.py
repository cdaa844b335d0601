from toy_runs import EPNP_TO_POSELIB, toy_run

from pipeline.report.families import base_of, difference, families, settings


def test_runs_that_differ_in_one_field_are_a_family_in_the_order_of_its_values():
    base = toy_run(at=9)
    rows = [toy_run(cluster__count=n) for n in (300, 40, 80)] + [base]
    (family,) = families(rows)
    assert family.axis == "cluster.count"
    assert family.values == (40, 80, 200, 300)
    assert family.base is base
    assert family.numeric


def test_two_sweeps_from_one_base_are_two_families_and_share_it():
    base = toy_run()
    rows = [base, toy_run(cluster__count=40), toy_run(fuse__dim=32), toy_run(fuse__dim=96)]
    found = {family.axis: family for family in families(rows)}
    assert set(found) == {"cluster.count", "fuse.dim"}
    assert found["fuse.dim"].values == (32, 64, 96)
    assert {family.base.id for family in found.values()} == {base.id}


def test_another_variant_counts_as_one_difference_whatever_its_fields():
    base, other = toy_run(), toy_run(solve=EPNP_TO_POSELIB)
    assert difference(settings(base), settings(other)) == {"solve": "poselib"}
    (family,) = families([base, other])
    assert (family.axis, set(family.values), family.numeric) == ("solve", {"epnp", "poselib"}, False)


def test_another_variant_within_a_variant_counts_as_one_difference_too():
    hog, dino = ({"_target_": f"a.{name}.A", "size": i} for i, name in enumerate(("hog", "dino")))
    base = toy_run(detect={"_target_": "d.cnos.D", "min_score": 0.1, "describe": hog})
    other = toy_run(detect={"_target_": "d.cnos.D", "min_score": 0.1, "describe": dino})
    assert difference(settings(base), settings(other)) == {"detect.describe": "dino"}
    larger = toy_run(detect={"_target_": "d.cnos.D", "min_score": 0.1, "describe": {**hog, "size": 7}})
    assert difference(settings(base), settings(larger)) == {"detect.describe.size": 7}


def test_runs_with_two_differences_belong_to_no_family_of_the_base():
    rows = [toy_run(), toy_run(cluster__count=40), toy_run(cluster__count=80, fuse__dim=32)]
    assert [family.values for family in families(rows)] == [(40, 200)]


def test_settings_that_cannot_change_results_make_no_family():
    assert families([toy_run(), toy_run(evaluate__theta_max=0.1)]) == []
    assert families([toy_run(), toy_run(out="elsewhere")]) == []


def test_switched_off_parts_and_oracles_stay_out_of_families():
    assert families([toy_run(), toy_run(variation="no_subpixel", correspond__kernel=1)]) == []


def test_the_base_is_the_run_that_most_others_differ_from_in_one_setting():
    rows = [toy_run(cluster__count=40, fuse__dim=32), toy_run(), toy_run(cluster__count=40), toy_run(fuse__dim=32)]
    assert base_of([*rows, toy_run(correspond__kernel=1)]).id == rows[1].id


def test_a_list_of_layers_is_a_value():
    (family,) = families([toy_run(), toy_run(fuse__layers=[8])])
    assert family.axis == "fuse.layers"
    assert set(family.values) == {(2, 5, 8, 11), (8,)}


def test_runs_scored_on_other_meshes_or_with_other_models_are_different_runs():
    base = toy_run(evaluate={"theta_max": 0.5, "models": "models_eval"})
    other = toy_run(evaluate={"theta_max": 0.1, "models": "models"})
    assert difference(settings(base), settings(other)) == {"evaluate.models": "models"}
    cad, scanned = (toy_run(dataset={"name": "tless", "models": models}) for models in ("cad", "reconst"))
    assert difference(settings(cad), settings(scanned)) == {"dataset.models": "reconst"}
