"""Albedo textures: PNG or JPEG bytes to linear RGB."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Hashable

import numpy as np
from PIL import Image

from difflpv.io.srgb import srgb_to_linear
from difflpv.scene import SceneError, Texture

__all__ = ["TextureLibrary"]

_MAX_PIXELS = 2**26  # of one scene: 805 MB of float32 RGB
_FORMATS = ("PNG", "JPEG")
_LINEAR = srgb_to_linear(np.arange(256) / 255).astype(np.float32)


class TextureLibrary:
    """Textures of one scene: each image is decoded once, and all of them together are bounded."""

    def __init__(self) -> None:
        self._textures: dict[Hashable, Texture] = {}
        self._pixels = 0

    def get(self, key: Hashable, where: str, read: Callable[[], bytes]) -> Texture:
        """The texture of ``key``, decoded from ``read()`` the first time.

        Args:
            key: what identifies the image in its file.
            where: element to be named in an error.
            read: gives the encoded bytes.

        Raises:
            SceneError: the image cannot be decoded, or is too large.
        """
        if key not in self._textures:
            self._textures[key] = Texture(self._decode(where, read()))
        return self._textures[key]

    def _decode(self, where: str, content: bytes) -> np.ndarray:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # size is bounded here, not by Pillow's warning
                image = Image.open(io.BytesIO(content), formats=_FORMATS)
                self._pixels += image.width * image.height
                if self._pixels > _MAX_PIXELS:
                    raise SceneError(f"{where}: textures of more than {_MAX_PIXELS} pixels in one scene")
                if image.mode.startswith("I"):  # 16-bit grey
                    grey = np.asarray(image, np.float64) / 65535
                    return np.repeat(srgb_to_linear(grey).astype(np.float32)[:, :, None], 3, axis=2)
                return _LINEAR[np.asarray(image.convert("RGB"))]
        except SceneError:
            raise
        except Exception as error:  # Pillow raises a dozen types on damaged images
            reason = " ".join(str(error).split()) or type(error).__name__
            if "cannot identify" in reason:
                reason = "neither PNG nor JPEG"
            raise SceneError(f"{where}: image cannot be decoded: {reason}") from None
