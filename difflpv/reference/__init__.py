"""Torch twins of the Warp kernels: readable, slow, exact; the oracle for values and gradients in the tests."""
