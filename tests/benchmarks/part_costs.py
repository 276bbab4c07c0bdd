"""The parts of a network by name, and what each costs by a clock of any kind, parts within parts left out."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from torch import nn

PARTS = {
    "images: plain convolutions": r"image_backbone",
    "images: deformable convolutions": r"image_backbone\.resnet\.stages\.\d\.\d\.spatial\.convolution",
    "images: feature pyramid": r"image_backbone\.pyramid",
    "BEV encoder: the rest": r"bev_encoder",
    "BEV encoder: attention to itself": r"bev_encoder\.layers\.\d\.self_attention",
    "BEV encoder: attention to images": r"bev_encoder\.layers\.\d\.image_attention",
    "BEV encoder: fusion of past maps": r"bev_encoder\.layers\.\d\.fusion|temporal_bev",
    "segmentation": r"segmentation_head",
    "propagation of tracks": r"propagation",
    "decoder: the rest": r"map_decoder",
    "decoder: attention to the BEV map": r"map_decoder\.layers\.\d\.bev_attention",
    "decoder: attention to track memory": r"map_decoder\.layers\.\d\.memory_attention",
    "query generator (Sec. 3.2)": r"query_generator|bev_pyramid",
    "instance masks (Sec. 3.2)": r"mask_head",
    "history map memory (Sec. 3.3)": r"history_memory",
    "history-map guidance (Sec. 3.4)": r"history_guidance",
    "short-term future guidance (Sec. 3.5)": r"future_guidance",
    "depth (training only)": r"depth_head",
}
OF_THE_PAPER = tuple(part for part in PARTS if "Sec." in part)
THE_REST = "selection, state and glue"


def part_of(name: str) -> str | None:
    """Return the part that a module begins, or None."""
    return next((part for part, pattern in PARTS.items() if re.fullmatch(pattern, name)), None)


def parameters_of_parts(network: nn.Module) -> Counter[str]:
    """Count parameters."""
    counts: Counter[str] = Counter()
    for name, parameter in network.named_parameters():
        path = name.split(".")
        prefixes = (".".join(path[:length]) for length in range(len(path), 0, -1))
        counts[next((part for prefix in prefixes if (part := part_of(prefix))), THE_REST)] += parameter.numel()
    return counts


class Ledger:
    """Sums up what a clock says while each part is at work; what a part within a part takes is the inner one's.

    Attributes:
        costs: by part, in the unit of the clock.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.costs: dict[str, float] = {}
        self._clock = clock
        self._at_work: list[str] = []
        self._since = 0.0

    @contextmanager
    def running(self, part: str) -> Iterator[None]:
        """Charge what is done meanwhile to a part."""
        self._enter(part)
        yield
        self._leave()

    @contextmanager
    def watching(self, network: Any) -> Iterator[None]:
        """Charge the forward passes of a network's modules to their parts."""
        with ExitStack() as stack:
            for name, module in network.named_modules():
                if part := part_of(name):
                    before = module.register_forward_pre_hook(lambda *_, part=part: self._enter(part))
                    stack.callback(before.remove)
                    stack.callback(module.register_forward_hook(lambda *_: self._leave()).remove)
            # These are not forward passes of a module.
            for owner, name, part in (
                (network.history_memory, "align", "history map memory (Sec. 3.3)"),
                (network.history_memory, "update", "history map memory (Sec. 3.3)"),
                (network.future_guidance, "forecast", "short-term future guidance (Sec. 3.5)"),
            ):
                if owner is not None:
                    setattr(owner, name, self._charged(getattr(owner, name), part))
                    stack.callback(delattr, owner, name)
            yield

    def _charged(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def charged(*arguments: Any) -> Any:
            with self.running(part):
                return function(*arguments)

        return charged

    def _enter(self, part: str) -> None:
        self._charge()
        self._at_work.append(part)

    def _leave(self) -> None:
        self._charge()
        self._at_work.pop()

    def _charge(self) -> None:
        now = self._clock()
        if self._at_work:
            part = self._at_work[-1]
            self.costs[part] = self.costs.get(part, 0.0) + now - self._since
        self._since = now
