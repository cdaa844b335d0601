"""Untrusted images, masks, depth images and RLE masks."""

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hostile import fuzz_settings, message_within, outcome
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.bop.images import image_size, read_depth, read_mask, read_rgb
from pipeline.bop.masks import decode_rle, read_rle

READERS = {"rgb": read_rgb, "mask": read_mask, "depth": lambda path: read_depth(path, 1.0), "size": image_size}


def encode_image(image: Image.Image, kind: str) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind)
    return stream.getvalue()


rng = np.random.default_rng(0)
PICTURES = [
    *(
        encode_image(Image.fromarray(rng.integers(0, 256, (12, 9, 3), np.uint8)), kind)
        for kind in ("PNG", "JPEG", "TIFF")
    ),
    *(
        encode_image(Image.fromarray(rng.integers(0, 256, (12, 9, 3), np.uint8)), kind)
        for kind in ("BMP", "WEBP", "GIF", "PPM")
    ),
    encode_image(Image.fromarray(rng.integers(0, 65536, (12, 9), np.uint16)), "PNG"),
    encode_image(Image.fromarray(rng.integers(0, 256, (12, 9, 4), np.uint8)), "PNG"),
    encode_image(Image.fromarray(rng.random((12, 9), np.float32)), "TIFF"),
]


@fuzz_settings(100)
@given(data=st.data())
def test_image_is_read_or_rejected_in_one_line(tmp_path_factory, data):
    content = bytearray(data.draw(st.sampled_from(PICTURES)))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path_factory.getbasetemp() / "image.png"
    path.write_bytes(content)
    for read in READERS.values():
        outcome(lambda read=read: read(path))


def png(width: int, height: int, *, bits: int = 8, colour: int = 2, rows: int = 1) -> bytes:
    """A PNG whose header claims a size, followed by ``rows`` kilobytes of zeros."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(rows << 10))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


BOMBS = {
    "2 billion columns": png(2**31 - 1, 1),
    "4 billion pixels": png(65_535, 65_535),
    "400 million pixels": png(20_000, 20_000),
    "16 bits": png(20_000, 20_000, bits=16, colour=0),
    "a long comment": b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 0x7FFFFFFF) + b"tEXt" + b"a" * 100,
    "program": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(ran) print\n%%EOF\n",
    "nothing": b"",
    "zero bytes": bytes(4096),
}


@pytest.mark.parametrize("case", BOMBS)
@pytest.mark.parametrize("reader", ["rgb", "mask", "depth"])
def test_claimed_image_size_costs_neither_time_nor_memory(tmp_path: Path, case: str, reader: str):
    path = tmp_path / "image.png"
    path.write_bytes(BOMBS[case])
    assert "image.png" in message_within(lambda: READERS[reader](path), seconds=5, megabytes=256)


def test_compressed_comment_is_not_a_bomb(tmp_path: Path):
    body = b"comment\0\0" + zlib.compress(bytes(256 << 20))
    head = png(4, 4)[:33]
    path = tmp_path / "image.png"
    path.write_bytes(
        head + struct.pack(">I", len(body)) + b"zTXt" + body + struct.pack(">I", zlib.crc32(b"zTXt" + body))
    )
    message_within(lambda: read_rgb(path), seconds=5, megabytes=128)


@pytest.mark.parametrize("reader", READERS)
def test_pipe_and_folder_are_rejected_as_images(tmp_path: Path, reader: str):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    for name, found in (("pipe.png", "not a regular file"), ("folder.png", "found a folder, needs an image")):
        assert found in outcome(lambda name=name: READERS[reader](tmp_path / name))


def test_postscript_is_rejected_and_not_run(tmp_path: Path, monkeypatch):
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path / 'ran'}\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (tmp_path / "photo.png").write_bytes(BOMBS["program"])
    assert "unknown image format" in outcome(lambda: read_rgb(tmp_path / "photo.png"))
    assert not (tmp_path / "ran").exists()


RUNS = st.lists(st.integers(-2, 60) | st.sampled_from([2**31, 2**63, 10**30, 0.5, None, True, "1"]), max_size=12)


@fuzz_settings(120)
@given(
    size=st.sampled_from([[12, 9], [9, 12], [12.0, 9.0], [0, 0], [2**31, 2**31], "12", None]),
    counts=RUNS
    | st.text(max_size=30)
    | st.text(alphabet=st.characters(min_codepoint=48, max_codepoint=111), max_size=40),
)
def test_rle_fits_the_image_or_is_rejected(size, counts):
    try:
        rle = read_rle({"size": size, "counts": counts}, (12, 9))
    except ValueError as error:
        message = str(error)
    else:
        assert decode_rle(rle).shape == (12, 9)
        return
    assert "\n" not in message


def test_huge_run_costs_no_memory():
    for counts in ("o" * 12 + "?" + "0" * 5, [1 << 62, 1 << 62]):
        with pytest.raises(ValueError, match="RLE counts"):
            read_rle({"size": [12, 9], "counts": counts}, (12, 9))
