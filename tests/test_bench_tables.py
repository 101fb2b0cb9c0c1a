"""Tables that benchmarks make of what a profiler writes."""

import pytest

from csac_jax.errors import SettingsError
from experiments.bench import step_kernels, warp_kernels

UNITS = {"seconds": "us", "bytes": "Mbyte", "active": "%", "issued": "%", "bandwidth": "%"}


def _csv(launches: list[tuple[str, dict[str, float]]]) -> str:
    """As ncu writes it: a line for each launch and metric, after other lines."""
    lines = ["==PROF== Connected", '"ID","Kernel Name","Metric Name","Metric Unit","Metric Value"']
    for number, (kernel, values) in enumerate(launches):
        for key, value in values.items():
            row = (number, kernel, warp_kernels.METRICS[key], UNITS[key], f"{value:,}")
            lines.append(",".join(f'"{each}"' for each in row))
    return "\n".join(lines)


def test_counters_are_weighed_by_time():
    """Claim: launches of a kernel are one row, whatever number its name ends in; shares add up, and
    counters are means over time."""
    idle = {"seconds": 1000.0, "bytes": 0.0, "active": 10.0, "issued": 0.0, "bandwidth": 0.0}
    busy = {"seconds": 3000.0, "bytes": 6000.0, "active": 50.0, "issued": 80.0, "bandwidth": 60.0}
    launches = [("one__locals__kernel_1234abcd", idle), ("one__locals__kernel_5678abcd", busy)]
    launches += [("two_0123abcd_cuda_kernel_forward", idle)]
    every, one, two = warp_kernels.table(_csv(launches))
    assert [row["kernel"] for row in (every, one, two)] == ["all", "one", "two"]
    assert [row["launches"] for row in (every, one, two)] == [3, 2, 1]
    assert [row["share"] for row in (every, one, two)] == pytest.approx([1.0, 0.8, 0.2])
    assert one["us"] == pytest.approx(2000.0)
    assert one["terabytes_per_second"] == pytest.approx(6e9 / 4e-3 * 1e-12)
    means = [one[key] for key in ("active", "issued", "bandwidth")]
    assert means == pytest.approx([0.40, 0.60, 0.45])


@pytest.mark.parametrize(
    ("kernel", "kind"),
    [
        ("_JTDACJ_sparse__locals__kernel_f7a9e7d7_cuda_kernel_forward", "physics"),
        ("sm80_xmma_fprop_implicit_gemm_bf16", "products"),
        ("gemm_fusion_dot_general_8", "products"),
        ("input_concatenate_fusion_7", "moves"),
        ("loop_convert_fusion_6", "moves"),
        ("input_reduce_select_fusion_4", "reductions"),
        ("ncclDevKernel_AllReduce_Sum_f32_RING_LL", "exchanges"),
        ("sort_23_1", "sorts"),
        ("MemcpyD2D", "copies"),
        ("loop_add_fusion_46", "other"),
    ],
)
def test_kernels_by_what_they_do(kernel: str, kind: str):
    """Claim: the names that XLA, cuDNN, NCCL and Warp give tell what a kernel does."""
    assert step_kernels.kind(kernel) == kind


def test_time_in_which_kernels_run():
    """Claim: the step lasts from the first kernel's start to the last one's end; a trace without a
    GPU is refused."""
    found = step_kernels.table([("gemm", 1.0, 3.0), ("sort", 4.0, 5.0), ("gemm", 8.0, 11.0)])
    assert (found["step_ms"], found["busy"]) == (10.0, 0.6)
    assert found["kinds"]["products"] == {"ms": 5.0, "launches": 2}
    assert list(found["kinds"]) == ["products", "sorts"]
    with pytest.raises(SettingsError, match="no GPU ran a kernel"):
        step_kernels.table([])
