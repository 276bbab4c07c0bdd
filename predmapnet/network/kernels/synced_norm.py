"""Batch norm whose statistics are those of all processes: on any device, and for batches of different sizes."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as distributed
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


class SyncedBatchNorm(nn.BatchNorm2d):
    """Batch norm over the frames of all processes. Outside of training it is an ordinary one."""

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(N, C, h, w)`` to the same shape."""
        if not self.training:
            return super().forward(features)
        normalised, mean, variance, count = _Normalise.apply(  # type: ignore[no-untyped-call]
            features, self.weight, self.bias, self.eps
        )
        with torch.no_grad():
            assert self.running_mean is not None and self.running_var is not None
            assert self.num_batches_tracked is not None and self.momentum is not None
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
        return normalised


def share_statistics(network: nn.Module) -> None:
    """Let the batch norms of a network, which is changed in place, normalise over all processes."""
    for module in network.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = SyncedBatchNorm


class _Normalise(torch.autograd.Function):
    """Statistics over all processes, and a gradient that knows that they depend on everyone's features."""

    @staticmethod
    def forward(
        context: Any, features: Tensor, weight: Tensor, bias: Tensor, epsilon: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        own_variance, own_mean = torch.var_mean(features.float(), dim=(0, 2, 3), correction=0)
        own = torch.stack([own_mean, own_variance, torch.full_like(own_mean, features[:, 0].numel())])
        everyone = [torch.empty_like(own) for _ in range(distributed.get_world_size())]
        distributed.all_gather(everyone, own)
        means, variances, counts = torch.stack(everyone).unbind(dim=1)
        count = counts.sum(dim=0)
        mean = (counts * means).sum(dim=0) / count
        variance = (counts * (variances + (means - mean).square())).sum(dim=0) / count
        context.save_for_backward(features, weight, mean, variance, count)
        context.epsilon = epsilon
        normalised = torch.batch_norm(features, weight, bias, mean, variance, False, 0.0, epsilon, True)
        context.mark_non_differentiable(mean, variance, count)
        return normalised, mean, variance, count

    @staticmethod
    @once_differentiable
    def backward(context: Any, gradient: Tensor, *_others: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        features, weight, mean, variance, count = context.saved_tensors
        # As if the statistics were fixed, which also sums up what belongs to weight and bias.
        direct, of_weight, of_bias = torch.ops.aten.native_batch_norm_backward(
            gradient, features, weight, mean, variance, None, None, False, context.epsilon, [True, True, True]
        )
        sums = torch.stack([of_bias, of_weight])
        distributed.all_reduce(sums)
        scale = (variance + context.epsilon).rsqrt()
        slope = weight * scale.square() * sums[1] / count
        shift = weight * scale * sums[0] / count - slope * mean
        through_statistics = torch.addcmul(shift.view(1, -1, 1, 1), features, slope.view(1, -1, 1, 1))
        return direct - through_statistics.to(direct.dtype), of_weight, of_bias, None
