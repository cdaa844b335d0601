from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import pytest

from pipeline.errors import BadInput
from pipeline.spec import NonNegative, Positive, Spec, build, canonical, digest, spec
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.correspond.cosine import Cosine
from pipeline.stages.fuse.template_pca import TemplatePca


@spec
class Toy(Spec):
    kind: ClassVar[str] = "match.toy"
    layer: NonNegative = 2
    weight: float = 1.0
    layers: tuple[int, ...] = (2, 5)
    mode: Literal["total", "per_layer"] = "total"
    flag: bool = True


@spec
class Outer(Spec):
    kind: ClassVar[str] = "extract.outer"
    first: Toy
    count: Positive = 3


def test_every_field_enters_the_recipe():
    recipe = {
        "kind": "match.toy",
        "version": 1,
        "layer": 2,
        "weight": 1.0,
        "layers": [2, 5],
        "mode": "total",
        "flag": True,
    }
    assert Toy().recipe() == recipe


@spec
class WithLaterFields(Spec):
    kind: ClassVar[str] = "match.toy"
    added: ClassVar[Mapping[str, Any]] = {"mode": "off", "size": 3}
    layer: NonNegative = 2
    mode: Literal["off", "on"] = "off"
    size: Positive = 3


def test_a_field_added_later_keeps_the_key_at_the_value_that_changes_nothing():
    before = {"kind": "match.toy", "version": 1, "layer": 2}
    assert WithLaterFields().recipe() == before
    assert WithLaterFields(mode="on").recipe() == before | {"mode": "on"}
    assert WithLaterFields(size=4).recipe() == before | {"size": 4}
    assert WithLaterFields(layer=5, mode="on", size=1).recipe() == before | {"layer": 5, "mode": "on", "size": 1}


@pytest.mark.parametrize("cls", [KMeans, Cosine])
def test_fields_added_later_exist_and_default_to_what_was_before(cls):
    assert {name: getattr(cls(), name) for name in cls.added} == dict(cls.added)


def test_nested_specs_enter_with_kind_and_version():
    assert Outer(first=Toy()).recipe()["first"] == Toy().recipe()


def test_values_of_different_types_have_different_digests():
    assert len({digest({"x": value}) for value in (1, 1.0, True, "1", [1], None)}) == 6


def test_the_order_of_fields_does_not_matter():
    assert canonical({"b": 1, "a": 2}) == canonical({"a": 2, "b": 1}) == '{"a":2,"b":1}'


def test_an_integer_for_a_float_is_converted():
    assert digest(build(Toy, {"weight": 2}, where="match").recipe()) == digest(Toy(weight=2.0).recipe())


def test_specs_are_frozen():
    with pytest.raises(AttributeError):
        Toy().layer = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"layer": -1}, "match.layer: found -1, needs greater than or equal to 0"),
        ({"layer": "2"}, "match.layer: found '2', needs a valid integer"),
        ({"layer": True}, "match.layer: found True, needs a valid integer"),
        ({"layer": 2.0}, "match.layer: found 2.0, needs a valid integer"),
        ({"layers": [2, "5"]}, "match.layers.1: found '5', needs a valid integer"),
        ({"mode": "both"}, "match.mode: found 'both', needs 'total' or 'per_layer'"),
        ({"flag": 1}, "match.flag: found 1, needs a valid boolean"),
        ({"top": 5}, "match.top: found an unknown field, needs one of: layer, weight, layers, mode, flag"),
    ],
)
def test_an_invalid_field_is_reported_in_one_line(values: dict, message: str):
    with pytest.raises(BadInput) as error:
        build(Toy, values, where="match")
    assert str(error.value) == message


def test_a_missing_field_is_named():
    with pytest.raises(BadInput, match=r"outer\.first: found nothing, needs a value"):
        build(Outer, {}, where="outer")


def test_too_many_and_too_few_values_are_reported():
    with pytest.raises(BadInput, match=r"fuse.layers: found \[2, 5\], needs at most 1 value$"):
        build(TemplatePca, {"layers": [2, 5]}, where="fuse")
    with pytest.raises(BadInput, match=r"fuse.layers: found \[\], needs at least 1 value$"):
        build(TemplatePca, {"layers": []}, where="fuse")
