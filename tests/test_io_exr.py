import struct

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import FUZZ

from difflpv.io.exr import ImageError, read_exr, read_image, write_exr, write_image


@pytest.fixture(scope="module")
def rgb():
    return np.random.default_rng(0).random((9, 13, 3)).astype(np.float32) * 1000


def test_round_trip_is_exact(tmp_path, rgb):
    path = tmp_path / "image.exr"
    write_image(path, rgb, rgb / 7, metadata={"scene": "cornell", "spp": 16, "seconds": 1.5})
    image, stderr = read_image(path)
    np.testing.assert_array_equal(image, rgb)
    np.testing.assert_array_equal(stderr, rgb / 7)
    channels, metadata = read_exr(path)
    assert set(channels) == {"R", "G", "B", "stderr.R", "stderr.G", "stderr.B"}
    assert all(c.dtype == np.float32 for c in channels.values())
    assert (metadata["scene"], metadata["spp"], metadata["seconds"]) == ("cornell", 16, 1.5)
    assert [p.name for p in tmp_path.iterdir()] == ["image.exr"]


STRIDED = [lambda a: a.transpose(2, 0, 1).copy().transpose(1, 2, 0), lambda a: a[::-1, ::2], lambda a: a.astype(float)]


@pytest.mark.parametrize("make", STRIDED)
def test_strided_and_other_dtypes(tmp_path, rgb, make):
    write_image(tmp_path / "a.exr", make(rgb))
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr")[0], make(rgb))


def test_agrees_with_the_library(tmp_path, rgb):
    write_image(tmp_path / "a.exr", rgb)
    np.testing.assert_array_equal(OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGB"].pixels, rgb)


def test_reads_half_float_and_piz(tmp_path, rgb):
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": rgb.astype(np.float16)}).write(str(tmp_path / "a.exr"))
    image, stderr = read_image(tmp_path / "a.exr")
    np.testing.assert_array_equal(image, rgb.astype(np.float16))
    assert stderr is None


def test_writer_refuses(tmp_path, rgb):
    path = tmp_path / "a.exr"
    for call, expected in [
        (lambda: write_exr(path, {}), "at least one channel"),
        (lambda: write_exr(path, {"R": rgb}), r"channel 'R': expected shape \[H, W\]"),
        (lambda: write_exr(path, {"R": rgb[..., 0], "G": rgb[1:, :, 0]}), "channel 'G': expected shape"),
        (lambda: write_exr(path, {"R": np.full((2, 2), np.nan)}), "channel 'R': 4 pixels are not finite"),
        (lambda: write_image(path, rgb[..., :2]), r"\[H, W, 3\], got \[9, 13, 2\]"),
        (lambda: write_exr(path, {"R": rgb[..., 0]}, {"type": "x"}), "metadata 'type'"),
        (lambda: write_exr(path, {"R": rgb[..., 0]}, {"n": 2**40}), "metadata 'n'"),
    ]:
        with pytest.raises(ImageError, match=expected):
            call()
    assert not path.exists()


def test_missing_and_foreign_files(tmp_path, rgb):
    with pytest.raises(ImageError, match=r"none\.exr: no such file"):
        read_exr(tmp_path / "none.exr")
    (tmp_path / "b.exr").write_bytes(b"not an image")
    with pytest.raises(ImageError, match="not an OpenEXR file"):
        read_exr(tmp_path / "b.exr")
    write_exr(tmp_path / "c.exr", {"Z": rgb[..., 0]})
    with pytest.raises(ImageError, match="channel R is missing, the file has Z"):
        read_image(tmp_path / "c.exr")


def _patched(content, attribute, kind, value):
    start = content.index(f"{attribute}\0{kind}\0".encode()) + len(attribute) + len(kind) + 6
    return content[:start] + value + content[start + len(value) :]


def test_hostile_headers_are_refused_before_the_library_sees_them(tmp_path, rgb):
    path = tmp_path / "a.exr"
    write_image(path, rgb)
    good = path.read_bytes()
    for content, expected in [
        (_patched(good, "dataWindow", "box2i", struct.pack("<4i", 0, 0, 10**6, 10**6)), "are more than"),
        (_patched(good, "dataWindow", "box2i", struct.pack("<4i", 0, 0, -5, 3)), "is empty"),
        (_patched(good, "compression", "compression", b"\x09"), "compression 9 is not read"),
        (good[:4] + struct.pack("<I", 2 | 0x800) + good[8:], "single-part scanline"),
        (good[:4] + struct.pack("<I", 2 | 0x200) + good[8:], "single-part scanline"),
        (good.replace(b"box2i\0" + struct.pack("<I", 16), b"box2i\0" + struct.pack("<I", 2**31 - 1)), "runs past"),
        (good[:100], "header|truncated"),
        (good[:-20], "damaged or truncated"),
    ]:
        path.write_bytes(content)
        with pytest.raises(ImageError, match=expected):
            read_exr(path)


@pytest.fixture(scope="module")
def intact(rgb, tmp_path_factory):
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    write_image(path, rgb, metadata={"scene": "cornell"})
    return path.read_bytes()


@settings(max_examples=200, **FUZZ)
@given(changes=st.lists(st.tuples(st.integers(0, 420), st.integers(0, 255)), min_size=1, max_size=5))
def test_damaged_bytes(tmp_path, intact, changes):
    path = tmp_path / "a.exr"
    content = bytearray(intact)
    for position, value in changes:
        content[position] = value
    path.write_bytes(content)
    try:
        channels, _ = read_exr(path)
    except ImageError as error:
        assert "\n" not in str(error) and "a.exr" in str(error)
    else:
        assert len({c.shape for c in channels.values()}) == 1
