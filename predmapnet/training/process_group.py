"""Training processes that share every step: on few cores, one thread in each beats threads that spin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as distributed
from torch import nn


@dataclass(frozen=True)
class ProcessGroup:
    """One process's view of all of them.

    Attributes:
        rank: number of this process; 0 writes files and talks.
        size: number of processes.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes files and talks."""
        return self.rank == 0

    def join(self, meeting_point: Path) -> None:
        """Meet the other processes at a file that none of them has used before."""
        if self.size > 1:
            address = f"file://{meeting_point.absolute()}"
            distributed.init_process_group(
                "gloo", init_method=address, rank=self.rank, world_size=self.size, timeout=timedelta(hours=1)
            )

    def leave(self) -> None:
        """Part from the others."""
        if self.size > 1:
            distributed.destroy_process_group()

    def wait(self) -> None:
        """Wait until every process is here."""
        if self.size > 1:
            distributed.barrier()

    def average_gradients(self, network: nn.Module, numbers: Sequence[float]) -> list[float]:
        """Average all gradients over the processes, and a few numbers with them.

        Args:
            network: parameters without a gradient take part with zeros, so that all processes agree.
            numbers: this process's numbers.

        Returns:
            Means of the numbers.
        """
        if self.size == 1:
            return list(numbers)
        parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([*(gradient.reshape(-1) for gradient in gradients), torch.tensor(numbers)])
        distributed.all_reduce(flat)
        flat /= self.size
        offset = 0
        for parameter, gradient in zip(parameters, gradients, strict=True):
            # Copied, so that the gradient keeps the memory layout of its weight.
            parameter.grad = gradient.copy_(flat[offset : offset + gradient.numel()].view_as(parameter))
            offset += gradient.numel()
        return [float(number) for number in flat[offset:]]

    def spread(self, network: nn.Module) -> None:
        """Give every process the weights and buffers of process 0."""
        if self.size > 1:
            for tensor in network.state_dict().values():
                distributed.broadcast(tensor, 0)
