"""Matrix products by the kernel that is fastest on this processor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

# torch.mm calls MKL, which gives processors that are not Intel's half the vector width. oneDNN compiles its
# kernels for the processor at hand, and reads transposed operands without a copy: on Zen 5, 220 instead of 95
# GFLOP/s a thread for (2048, 864) by (864, 32), both true float32. PyTorch's own compiler uses this operator.
_HAS_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def linear(a: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`torch.nn.functional.linear` without a gradient: (M, K) by (N, K) to (M, N), plus (N,)."""
    if _HAS_ONEDNN and a.device.type == "cpu" and a.dtype == torch.float32 and torch.backends.mkldnn.enabled:
        result: Tensor = torch.ops.mkldnn._linear_pointwise(a, weight, bias, "none", [], "")
        return result
    return nn.functional.linear(a, weight, bias)
