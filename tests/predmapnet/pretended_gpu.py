"""A GPU without a GPU: fake tensors that say they are on it, beside their values, which are computed on the CPU.

The fake tensors decide about devices: an operation on tensors of two devices fails as it would on a GPU. The values let
everything run that depends on them (assignment, selection of tracks). What is brought to the CPU is an ordinary tensor.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import (
    DataDependentOutputException,
    DynamicOutputShapeException,
    FakeTensor,
    FakeTensorMode,
    unset_fake_temporarily,
)
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map, tree_map_only

NAME = "pretended"


def gpu_device() -> torch.device:
    """A CUDA device; where there is none, torch refuses fake ones gradients, so it is a device of our own."""
    if torch.cuda.is_available():
        return torch.device("cuda:0")
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip(f"torch {torch.__version__} cannot pretend to have a device")
    if torch._C._get_privateuse1_backend_name() != NAME:
        backend_registration._setup_privateuseone_for_python_backend(NAME)
        # From then on, torch takes this device for the default one in every later test and asks it for its precisions.
        vars(getattr(torch, NAME)).setdefault("get_amp_supported_dtype", lambda: [torch.bfloat16])
    return torch.device(f"{NAME}:0")


class _NoDevice(FakeTensorMode):
    """Fake tensors of a device that must not be touched, although it says that it is there."""

    avoid_device_init = True

    def __deepcopy__(self, memo: dict[int, Any]) -> _NoDevice:
        return self  # Copies of a tensor belong to the same mode.


class PretendedGpu(TorchDispatchMode):
    """Runs every operation twice: on fake tensors for shapes and devices, and on the CPU for values.

    Attributes:
        device: where the fake tensors say they are.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device = device
        self._fakes = _NoDevice(allow_non_fake_inputs=False)

    def put(self, value: Any) -> Any:
        """Bring a tensor, or all tensors of a dataclass or container, to the GPU."""
        if is_dataclass(value) and not isinstance(value, type):
            return replace(value, **{field.name: self.put(getattr(value, field.name)) for field in fields(value)})
        return tree_map_only(Tensor, lambda tensor: self._fake(tensor.detach(), self.device), value)

    def put_network(self, network: nn.Module) -> None:
        """Bring all parameters and buffers to the GPU."""
        for module in network.modules():
            for name, value in list(module.named_parameters(recurse=False)):
                setattr(module, name, nn.Parameter(self.put(value), requires_grad=value.requires_grad))
            for name, value in list(module.named_buffers(recurse=False)):
                setattr(module, name, self.put(value))

    def _fake(self, value: Tensor, device: torch.device) -> FakeTensor:
        with self._fakes:
            fake = torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=device)
        fake.value = value
        return fake

    def __enter__(self) -> PretendedGpu:
        self._fakes.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._fakes.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.prim.device.default:
            return args[0].fake_device
        given = (args, kwargs or {})
        on_gpu = False

        def value_of(item: Any) -> Any:
            nonlocal on_gpu
            if isinstance(item, FakeTensor):
                on_gpu = True
                return item.value
            if isinstance(item, torch.device) and item == self.device:
                on_gpu = True
                return torch.device("cpu")
            return item

        def fake_of(item: Any) -> Any:
            plain = isinstance(item, Tensor) and not isinstance(item, FakeTensor)
            return self._fake(item, item.device) if plain else item

        value_args, value_kwargs = tree_map(value_of, given)
        with unset_fake_temporarily():
            values = func(*value_args, **value_kwargs)
        if not on_gpu:
            return values
        fake_args, fake_kwargs = tree_map(fake_of, given)
        try:
            with self._fakes:
                fakes = func(*fake_args, **fake_kwargs)
        except (DataDependentOutputException, DynamicOutputShapeException):
            return tree_map_only(Tensor, lambda value: self._fake(value, self.device), values)
        return tree_map(self._joined, fakes, values)

    @staticmethod
    def _joined(fake: Any, value: Any) -> Any:
        """Give a fake result its value; what is on the CPU is the value."""
        if not isinstance(fake, FakeTensor) or not isinstance(value, Tensor) or fake.device.type == "cpu":
            return value
        if fake.shape == value.shape and fake.stride() != value.stride():
            # Kernels of a GPU may lay out what they make in another way; views of it must be views of both.
            with unset_fake_temporarily():
                value = torch.empty_strided(fake.shape, fake.stride(), dtype=value.dtype).copy_(value)
        fake.value = value
        return fake


@contextmanager
def pretended_gpu() -> Iterator[PretendedGpu]:
    """Run a block with a GPU that is not there. Gradients are computed in the calling thread."""
    gpu = PretendedGpu(gpu_device())
    with warnings.catch_warnings(), torch.autograd.set_multithreading_enabled(False), gpu:
        warnings.simplefilter("ignore")
        yield gpu
