"""Differentiable light propagation volumes: inverse lighting in PyTorch with NVIDIA Warp kernels."""

__all__ = ["__version__"]

__version__ = "0.1.0"
