"""What is native in the kernels compiles for a GPU, also where there is none: Warp brings the compiler."""

import re

import pytest
import warp as wp

from nsf.engines.modal.gathering import make_contraction, make_gathering
from nsf.engines.modal.networks import make_layer, make_product
from nsf.engines.modal.placing import make_neighbours, make_sample
from nsf.engines.modal.projection import make_projection
from nsf.mpm import precision_of
from nsf.mpm.step import make_grid_update, make_update_g2p
from nsf.mpm.transfer.g2p import make_g2p
from nsf.mpm.transfer.p2g import make_p2g

ARCH = 90  # compute capability 9.0, which has reductions of its own in P2G
KERNELS = {
    "p2g": lambda precision, several: make_p2g(precision, "quadratic", batch=several),
    "p2g_by_warp": lambda precision, several: make_p2g(precision, "quadratic", False, several, by_warp=True),
    "p2g_cubic": lambda precision, several: make_p2g(precision, "cubic", False, several, by_warp=True),
    "grid_update": lambda precision, several: make_grid_update(precision),
    "g2p": lambda precision, several: make_g2p(precision, "quadratic"),
    "update_g2p": lambda precision, several: make_update_g2p(precision, "quadratic", several),
    "sample": lambda precision, several: make_sample(precision, "quadratic", several),
    "others": lambda precision, several: make_neighbours(precision, "quadratic", 9, 2, several, wp.float16),
    "contraction": lambda precision, several: make_contraction(
        precision, (9, 8), precision.real, 2, several, wp.float16
    ),
    "layer": lambda precision, several: make_layer(precision, 2, several),
    "first_layers": lambda precision, several: make_layer(precision, 2, several, 5),
    "product": lambda precision, several: make_product(precision),
    "gathering": lambda precision, several: make_gathering(precision, several),
    "projection": lambda precision, several: make_projection(precision, (5, 48, 48, 31), 2, 5, 36, several),
}


@pytest.mark.slow
@pytest.mark.skipif(ARCH not in wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize("several", [False, True], ids=["one", "several"])
@pytest.mark.parametrize("precision", ["fp32", "fp64"])
@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_compiles_for_a_gpu(name, precision, several, tmp_path):
    made = KERNELS[name](precision_of(precision), several)
    for kernel in made if isinstance(made, tuple) else (made,):
        wp.compile_aot_module(kernel.module, arch=ARCH, module_dir=tmp_path, use_ptx=True)
    assert list(tmp_path.glob("*.ptx"))


@pytest.mark.skipif(ARCH not in wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize("members", [1, 4])
def test_blocks_of_the_projection_do_not_wait_for_each_other(members, tmp_path):
    """Nothing makes them run at once, so a wait could hang; without an atomic or a fence there is none."""
    kernel = make_projection(precision_of("fp32"), (5, 48, 48, 31), members, 5, 36)
    wp.compile_aot_module(kernel.module, arch=ARCH, module_dir=tmp_path, use_ptx=True)
    (ptx,) = tmp_path.glob("*.ptx")
    assert not re.findall(r"\b(?:atom|red|membar|fence|ld\.volatile)\.\S+", ptx.read_text())


@pytest.mark.skipif(80 not in wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize("precision", ["fp32", "fp64"])
def test_p2g_compiles_for_a_gpu_without_reductions_of_vectors(precision, tmp_path):
    kernel = make_p2g(precision_of(precision), "quadratic", by_warp=True)
    wp.compile_aot_module(kernel.module, arch=80, module_dir=tmp_path, use_ptx=True)
    assert list(tmp_path.glob("*.ptx"))
