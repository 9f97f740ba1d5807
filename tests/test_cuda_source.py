"""The CUDA side of every kernel compiles to PTX: NVRTC comes with Warp, so no GPU is needed to see that."""

import pytest
import warp as wp

from difflpv import bridge
from warp_kernels.direct import direct_kernels
from warp_kernels.gaussian import gaussian_kernels
from warp_kernels.injection import injection_kernels
from warp_kernels.linear_propagation import matrices_kernel, step_kernel
from warp_kernels.occlusion import occlusion_kernels
from warp_kernels.propagation import adjoint_kernel, forward_kernel
from warp_kernels.rsm import rsm_kernels
from warp_kernels.sampling import sampling_kernels
from warp_kernels.tetrahedra import tetrahedra_kernels
from warp_kernels.weighted import weighted_kernels

FACES = {"coeffs": 9, "axes": 6, "channels": 3, "lanes": 1, "clamp": True, "occluded": True}
PAIRS = {"coeffs": 9, "lanes": 1, "occluded": True}
KERNELS = {
    "linear propagation": lambda s: step_kernel(s, **PAIRS, paired=True),
    "linear propagation adjoint": lambda s: step_kernel(
        s, **PAIRS, paired=False, adjoint=True, need_factor=True, need_transmittance=True
    ),
    "linear propagation matrices": lambda s: matrices_kernel(s, **PAIRS),
    "propagation": lambda s: forward_kernel(s, **FACES),
    "propagation adjoint": lambda s: adjoint_kernel(s, **FACES, need_factor=True, need_transmittance=True),
    "direct": lambda s: direct_kernels(s)[0],
    "gaussian": lambda s: gaussian_kernels(s).nearest_of_all,
    "injection": lambda s: injection_kernels(s)[0],
    "occlusion": lambda s: occlusion_kernels(s)[0],
    "rsm": lambda s: rsm_kernels(s)[0],
    "sampling": lambda s: sampling_kernels(s)[0],
    "tetrahedra": lambda s: tetrahedra_kernels(s).locate,
    "weighted": lambda s: weighted_kernels(s)[0],
}


@pytest.mark.parametrize("scalar", [wp.float32, wp.float64])
@pytest.mark.parametrize("stage", KERNELS)
def test_kernels_compile_for_cuda(stage, scalar, tmp_path):
    assert bridge  # importing it initialises Warp quietly
    kernel = KERNELS[stage](scalar)
    wp.compile_aot_module(kernel.module, arch=75, module_dir=str(tmp_path), use_ptx=True)
    (ptx,) = tmp_path.glob("*.ptx")
    assert f".entry {kernel.key}" in ptx.read_text() or kernel.key.split(".")[-1] in ptx.read_text()
