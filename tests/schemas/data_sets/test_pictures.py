"""Pictures from elsewhere: PNG and JPEG, and no program that pillow starts for another format."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from tests.kit.lerobot_data_sets import encoded, numbered_picture
from vla_attention.schemas.data_sets.data_set_files import DamagedDataSet
from vla_attention.schemas.data_sets.data_set_reader import decode_picture

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 64\n%%EndComments\nshowpage\n"


def test_png_and_jpeg_are_decoded():
    picture = numbered_picture(5)
    np.testing.assert_array_equal(decode_picture("it", encoded("PNG", picture)), picture)
    decoded = decode_picture("it", encoded("JPEG", picture, quality=95))
    assert decoded.shape == picture.shape
    assert decoded.flags.writeable
    assert np.abs(decoded.astype(int) - picture).mean() < 3


@pytest.mark.parametrize("kind", ["GIF", "TIFF"])
def test_other_formats_are_refused(kind):
    with pytest.raises(DamagedDataSet, match="it"):
        decode_picture("it", encoded(kind, numbered_picture(5)))


def test_no_program_is_started_for_an_eps(tmp_path, monkeypatch):
    """Pillow gives an EPS to Ghostscript, an interpreter of programs, by the first bytes of a file."""
    trace = tmp_path / "started"
    program = tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {trace}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    with pytest.raises(OSError, match=r"."), Image.open(io.BytesIO(EPS)) as image:
        image.convert("RGB")
    assert trace.exists()  # the attack is one
    trace.unlink()
    with pytest.raises(DamagedDataSet):
        decode_picture("it", EPS)
    assert not trace.exists()


def test_a_picture_of_a_billion_pixels_is_refused_before_it_is_decoded():
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header
    content += struct.pack(">I", zlib.crc32(b"IHDR" + header))
    with pytest.raises(DamagedDataSet, match="900000000 pixels"):
        decode_picture("it", content + struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", zlib.crc32(b"IDAT")))
