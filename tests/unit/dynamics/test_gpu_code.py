"""What is native in the kernels compiles for a GPU, also where there is none: Warp brings the compiler."""

import pytest
import warp as wp

from nsf.dynamics.modal_kernels import make_contraction, make_gathering, make_position
from nsf.dynamics.network_kernel import make_layer
from nsf.dynamics.projection_kernel import make_projection
from nsf.dynamics.selection_kernels import make_selection
from nsf.mpm import precision_of
from nsf.mpm.transfer import make_g2p, make_p2g

ARCH = 90  # compute capability 9.0, which has reductions of its own in P2G
KERNELS = {
    "p2g": lambda precision, several: make_p2g(precision, "quadratic", several=several),
    "g2p": lambda precision, several: make_g2p(precision, "quadratic", several=several),
    "position": lambda precision, several: make_position(precision, 9, 2, several),
    "selection": lambda precision, several: make_selection(precision, "quadratic", several),
    "contraction": lambda precision, several: make_contraction(
        precision, 9, True, precision.real, 2, several, wp.float16
    ),
    "layer": lambda precision, several: make_layer(precision, 2, several),
    "gathering": lambda precision, several: make_gathering(precision, several),
    "projection": lambda precision, several: make_projection(precision, (5, 48, 48, 31), 2, 5, 36, several),
}


@pytest.mark.skipif(ARCH not in wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize("several", [False, True], ids=["one", "several"])
@pytest.mark.parametrize("precision", ["fp32", "fp64"])
@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_compiles_for_a_gpu(name, precision, several, tmp_path):
    made = KERNELS[name](precision_of(precision), several)
    for kernel in made if isinstance(made, tuple) else (made,):
        wp.compile_aot_module(kernel.module, arch=ARCH, module_dir=tmp_path, use_ptx=True)
    assert list(tmp_path.glob("*.ptx"))
