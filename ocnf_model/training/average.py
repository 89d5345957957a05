"""The running average of the weights: better than the last of them while the learning rate is high."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class WeightAverage:
    """Exponential moving average of a module's weights and buffers (Polyak and Juditsky 1992).

    After step n (from 1) the average keeps a share min(decay, n / (n + 9)) of itself and takes the rest from
    the weights, so that a young average does not remember the first weights. Whole numbers are copied.

    Args:
        module: whose weights; the average begins with them.
        decay: the share, in [0, 1).
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self._module, self._decay = module, decay
        self.tensors: dict[str, Tensor] = {name: tensor.detach().clone()
                                           for name, tensor in module.state_dict().items()}

    @torch.no_grad()
    def update(self, steps: int) -> None:
        """Take in the weights after a step.

        Args:
            steps: number of steps so far, with this one.
        """
        kept = min(self._decay, steps / (steps + 9))
        for name, tensor in self._module.state_dict().items():
            if tensor.is_floating_point():
                self.tensors[name].lerp_(tensor, 1 - kept)
            else:
                self.tensors[name].copy_(tensor)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on with an average that was kept; nothing where there is none."""
        for name, tensor in tensors.items():
            self.tensors[name].copy_(tensor)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """The module has the averaged weights within, its own again after."""
        own = {name: tensor.detach().clone() for name, tensor in self._module.state_dict().items()}
        self._module.load_state_dict(self.tensors)
        try:
            yield
        finally:
            self._module.load_state_dict(own)
