"""OpenEXR images with named float32 channels: ``R,G,B`` and, where known, ``stderr.R,stderr.G,stderr.B``.

The OpenEXR library parses whatever a header claims, so the header is walked and bounded here first: one part,
scanlines, a plain lossless codec, a bounded number of pixels. Source: "OpenEXR File Layout", openexr.com.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from difflpv.io.atomic import atomic_path

__all__ = ["ImageError", "read_exr", "read_image", "write_exr", "write_image"]

_MAGIC = 20000630
_MAX_HEADER = 2**20  # bytes
_MAX_VALUES = 2**27  # pixels times channels of one image: 512 MiB of float32
_CODECS = ("none", "RLE", "ZIPS", "ZIP", "PIZ")
_STRUCTURE = ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "type")


class ImageError(ValueError):
    """An image that cannot be read or written: one line naming file and reason."""


def _header_attributes(path: Path, content: bytes) -> dict[str, tuple[str, bytes]]:
    """Attributes of the first header as (type, raw value) by name."""
    if len(content) < 8 or struct.unpack_from("<I", content)[0] != _MAGIC:
        raise ImageError(f"{path}: not an OpenEXR file")
    version = struct.unpack_from("<I", content, 4)[0]
    if version & 0xFF != 2 or version & (0x200 | 0x800 | 0x1000):
        raise ImageError(f"{path}: expected a single-part scanline OpenEXR file (tiles, deep and multi-part not read)")
    attributes: dict[str, tuple[str, bytes]] = {}
    position = 8
    while True:
        texts = []
        for _ in range(2):
            end = content.find(b"\0", position, position + 256)
            if end < 0 or end > _MAX_HEADER:
                raise ImageError(f"{path}: header is damaged or larger than {_MAX_HEADER} bytes")
            texts.append(content[position:end].decode("latin-1"))
            position = end + 1
            if not texts[0]:
                return attributes
        if position + 4 > len(content):
            raise ImageError(f"{path}: truncated in the header")
        size = struct.unpack_from("<i", content, position)[0]
        position += 4
        if size < 0 or position + size > min(len(content), _MAX_HEADER):
            raise ImageError(f"{path}: attribute '{texts[0]}' is damaged or runs past the header's end")
        attributes[texts[0]] = (texts[1], content[position : position + size])
        position += size


def _check_channels(path: Path, raw: bytes) -> int:
    """Number of channels of a ``chlist``; checks pixel types and sampling."""
    position, count = 0, 0
    while position < len(raw) and raw[position] != 0:
        end = raw.find(b"\0", position)
        if end < 0 or end + 17 > len(raw):
            raise ImageError(f"{path}: channel list is damaged")
        name = raw[position:end].decode("latin-1")
        pixel_type, _, x_sampling, y_sampling = struct.unpack_from("<iiii", raw, end + 1)
        if pixel_type not in (1, 2) or (x_sampling, y_sampling) != (1, 1):
            raise ImageError(f"{path}: channel '{name}': expected half or float pixels without subsampling")
        position, count = end + 17, count + 1
    if not count:
        raise ImageError(f"{path}: no channels")
    return count


def _check_header(path: Path, content: bytes) -> None:
    attributes = _header_attributes(path, content)
    for name, kind, size in (
        ("channels", "chlist", None),
        ("compression", "compression", 1),
        ("dataWindow", "box2i", 16),
        ("displayWindow", "box2i", 16),
        ("lineOrder", "lineOrder", 1),
    ):
        found = attributes.get(name)
        if found is None or found[0] != kind or (size is not None and len(found[1]) != size):
            raise ImageError(f"{path}: header attribute '{name}' is missing or damaged")
    codec = attributes["compression"][1][0]
    if codec >= len(_CODECS):
        raise ImageError(f"{path}: compression {codec} is not read, expected one of {', '.join(_CODECS)}")
    x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"][1])
    width, height = x1 - x0 + 1, y1 - y0 + 1
    if width < 1 or height < 1:
        raise ImageError(f"{path}: data window {width} x {height} is empty")
    values = width * height * _check_channels(path, attributes["channels"][1])
    if values > _MAX_VALUES:
        raise ImageError(f"{path}: {width} x {height} pixels are more than {_MAX_VALUES} values")


def read_exr(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str | int | float]]:
    """Read a single-part scanline OpenEXR image.

    Returns:
        Channels by name, float32 [H,W], row 0 at the top; and the text and number attributes of the header.

    Raises:
        ImageError: one line naming the file and the reason.
    """
    path = Path(path)
    if not path.is_file():
        raise ImageError(f"{path}: no such file")
    content = path.read_bytes()
    _check_header(path, content)
    # OpenEXR prints that pixels could not be read and goes on without them: what it prints is an error here.
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            file = OpenEXR.File(str(path), separate_channels=True)
            channels = {name: np.ascontiguousarray(c.pixels, np.float32) for name, c in file.channels().items()}
            header = file.header()
    except Exception as error:  # RuntimeError, ValueError, TypeError, UnicodeDecodeError
        reason = printed.getvalue() or str(error) or type(error).__name__
        raise ImageError(f"{path}: damaged or truncated OpenEXR file: {' '.join(reason.split())}") from None
    if printed.getvalue():
        raise ImageError(f"{path}: damaged or truncated OpenEXR file: {' '.join(printed.getvalue().split())}")
    metadata = {k: v for k, v in header.items() if isinstance(v, (str, int, float)) and k not in _STRUCTURE}
    return channels, metadata


def write_exr(
    path: str | Path, channels: Mapping[str, np.ndarray], metadata: Mapping[str, str | int | float] | None = None
) -> None:
    """Write float32 channels as a ZIP-compressed OpenEXR image, atomically.

    Args:
        path: file to write.
        channels: images [H,W] by channel name, all of one size; any strides, any real dtype.
        metadata: text and numbers for the header.

    Raises:
        ImageError: no channels, unequal sizes, or pixels that are not finite.
    """
    path = Path(path)
    pixels: dict[str, np.ndarray] = {}
    for name, image in channels.items():
        # Contiguous always: OpenEXR writes wrong pixels for strided arrays.
        pixels[name] = np.ascontiguousarray(image, np.float32)
        first = next(iter(pixels.values()))
        if pixels[name].ndim != 2 or pixels[name].shape != first.shape or not pixels[name].size:
            shape = list(np.shape(image))
            raise ImageError(f"{path}: channel '{name}': expected shape [H, W] as the others, got {shape}")
        bad = int((~np.isfinite(pixels[name])).sum())
        if bad:
            raise ImageError(f"{path}: channel '{name}': {bad} pixels are not finite")
    if not pixels:
        raise ImageError(f"{path}: expected at least one channel, got none")
    header: dict[str, object] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in (metadata or {}).items():
        if key in _STRUCTURE or not isinstance(value, (str, int, float)) or isinstance(value, bool):
            raise ImageError(f"{path}: metadata '{key}': expected text or a number under a free name, got {value!r}")
        if not isinstance(value, str) and not (math.isfinite(value) and abs(value) < 2**31):
            raise ImageError(f"{path}: metadata '{key}': expected a number below 2^31, got {value!r}")
        header[key] = value
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
        except Exception as error:
            raise ImageError(f"{path}: cannot be written: {' '.join(str(error).split())}") from None


def write_image(
    path: str | Path,
    rgb: np.ndarray,
    stderr: np.ndarray | None = None,
    *,
    metadata: Mapping[str, str | int | float] | None = None,
) -> None:
    """Write a linear RGB image [H,W,3], and its standard error [H,W,3] as ``stderr.R,stderr.G,stderr.B``."""
    channels: dict[str, np.ndarray] = {}
    for prefix, image in (("", rgb), ("stderr.", stderr)):
        if image is None:
            continue
        if np.ndim(image) != 3 or np.shape(image)[2] != 3:
            raise ImageError(f"{path}: expected an image of shape [H, W, 3], got {list(np.shape(image))}")
        channels |= {prefix + name: np.asarray(image)[:, :, k] for k, name in enumerate("RGB")}
    write_exr(path, channels, metadata)


def read_image(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Linear RGB image float32 [H,W,3] and its standard error [H,W,3], None where the file has none."""
    channels, _ = read_exr(path)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise ImageError(f"{path}: channel {missing[0]} is missing, the file has {', '.join(channels)}")
    rgb = np.stack([channels[name] for name in "RGB"], -1)
    names = [f"stderr.{name}" for name in "RGB"]
    return rgb, np.stack([channels[name] for name in names], -1) if set(names) <= set(channels) else None
