"""Warp kernels of the stages: forward and hand-written adjoint side by side, one file per stage, no torch.

Each file hands out its kernels for one scalar type (``wp.float32`` or ``wp.float64``) from a cached factory, in a
Warp module of its own, so that a run compiles only the precision and the stages that it uses.
"""
