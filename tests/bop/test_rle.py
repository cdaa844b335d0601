import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco

from pipeline.bop.masks import decode_rle, encode_rle, read_rle, rle_area, to_uncompressed


def encode_by_loop(mask: np.ndarray) -> list[int]:
    """Column-major runs, background first, written as a plain loop."""
    runs, value = [0], False
    for pixel in mask.T.ravel():
        if bool(pixel) != value:
            runs.append(0)
            value = not value
        runs[-1] += 1
    return runs


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**81 - 1))
def test_compressed_and_uncompressed_rle_decode_to_the_same_mask(h: int, w: int, bits: int):
    mask = np.array([bits >> i & 1 for i in range(h * w)], dtype=bool).reshape(h, w)
    compressed = encode_rle(mask)
    as_list = {"size": [h, w], "counts": encode_by_loop(mask)}
    padded = {"size": [h, w], "counts": [*as_list["counts"], 0, 0]}
    for given_rle in (compressed, as_list, padded):
        assert read_rle(given_rle, (h, w)) == compressed
    np.testing.assert_array_equal(decode_rle(compressed), mask)
    assert to_uncompressed(compressed) == as_list
    assert rle_area(compressed) == mask.sum()


def test_long_runs_survive_compression():
    mask = np.zeros((480, 640), dtype=bool)
    mask[100:300, 200:500] = True  # runs of 96100, 200 and 280 need one to four characters
    assert read_rle(encode_rle(mask), (480, 640)) == encode_rle(mask)


def test_rle_of_pycocotools_decodes_to_the_same_mask():
    mask = np.random.default_rng(0).random((48, 64)) > 0.7
    rle = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    read = read_rle({"size": [48, 64], "counts": rle["counts"].decode()}, (48, 64))
    np.testing.assert_array_equal(coco.decode(read), mask)


@pytest.mark.parametrize(
    ("segmentation", "part"),
    [
        ({"size": [4, 6], "counts": [24]}, "mask of [4, 6] where the image is [6, 4]"),
        ({"size": [6, 4], "counts": [5, 5]}, "cover 10 pixels, the image has 24"),
        ({"size": [6, 4], "counts": [30, -6]}, "integers >= 0"),
        ({"size": [6, 4], "counts": [12.0, 12]}, "integers >= 0"),
        ({"size": [6, 4], "counts": [True, 23]}, "integers >= 0"),
        ({"size": [6, 4], "counts": "\u20ac!"}, "not a compressed string"),
        ({"size": [6, 4], "counts": "oooooooooooooooooooooo"}, "not a compressed string"),
        ({"size": [6, 4], "counts": "h"}, "middle of a number"),
        ({"size": [6, 4], "counts": "99"}, "cover 18 pixels"),
        ({"size": [6, 4], "counts": ""}, "cover 0 pixels"),
        ({"size": [6, 4], "counts": None}, "integers >= 0"),
        ({"counts": [24]}, "not an RLE"),
        ([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]], "not an RLE"),
    ],
)
def test_broken_rle_is_refused_before_it_reaches_the_c_library(segmentation: object, part: str):
    with pytest.raises(ValueError, match=re.escape(part)) as raised:
        read_rle(segmentation, (6, 4))
    assert "\n" not in str(raised.value)
