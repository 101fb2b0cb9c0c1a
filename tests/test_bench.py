"""The benchmarks' own arithmetic."""

import jax
import jax.numpy as jnp
import pytest

from csac_jax import presets
from csac_jax.errors import SettingsError
from csac_jax.nets import dense
from experiments.bench import __main__ as page, learner, step_kernels


def test_operations_are_those_of_the_net():
    """Claim: the operations of a pass are XLA's count of its convolutions and products, to 3 %:
    XLA leaves out the taps beyond the borders, and counts the norms."""
    net = presets.quick().net
    cells = 64
    maps = jnp.zeros((1, cells * net.stride, cells * net.stride, 4))
    critic = dense.Critic(net)
    variables = jax.eval_shape(critic.init, jax.random.key(0), maps)
    counted = jax.jit(critic.apply).lower(variables, maps).cost_analysis()["flops"]
    ours = sum(learner._operations(net, 4, cells).values())
    assert abs(ours / counted - 1.0) < 0.03, (ours, counted)


def test_kernels_by_name():
    """Claim: the names that XLA, cuDNN, NCCL and Warp give tell what a kernel does."""
    kinds = {
        "_JTDACJ_sparse__locals__kernel_f7a9e7d7_cuda_kernel_forward": "physics",
        "sm80_xmma_fprop_implicit_gemm_bf16": "products",
        "input_concatenate_fusion_7": "moves",
        "input_reduce_select_fusion_4": "reductions",
        "ncclDevKernel_AllReduce_Sum_f32_RING_LL": "exchanges",
        "sort_23_1": "sorts",
        "loop_add_fusion_46": "other",
    }
    assert {name: step_kernels.kind(name) for name in kinds} == kinds


def test_time_in_which_kernels_run():
    """Claim: the step lasts from the first kernel's start to the last one's end; a trace without a
    GPU is refused."""
    found = step_kernels.table([("gemm", 1.0, 3.0), ("sort", 4.0, 5.0), ("gemm", 8.0, 11.0)])
    assert (found["step_ms"], found["busy"]) == (10.0, 0.6)
    assert found["kinds"]["products"] == {"ms": 5.0, "launches": 2}
    with pytest.raises(SettingsError, match="no GPU ran a kernel"):
        step_kernels.table([])


def test_page_shows_figures_and_failures():
    """Claim: the page of `make bench` has the main figures of a result, or why there is none."""
    rates = [{"actions_per_second": rate} for rate in (1.25, 3.0)]
    shown = [row["value"] for row in page.rows("sweep", {"rows": rates, "wall_seconds": 2})]
    assert shown == ["1.25", "3", "2"]
    (row,) = page.rows("sweep", {"failed": "no room", "wall_seconds": 2})
    assert row == {"benchmark": "sweep", "figure": "failed", "value": "no room"}
    assert page.FIGURES.keys() == page.MAIN.keys()
