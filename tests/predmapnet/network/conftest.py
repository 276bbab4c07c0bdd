"""A network small enough for tests, and streams of random frames."""

from collections.abc import Callable, Iterator

import pytest
import torch

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate, collate_calibrations
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from tests.predmapnet.small_networks import small_config


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Tiny tensors are not worth a second thread, and wait for it long where the cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def make_network() -> Callable[..., PredMapNet]:
    """Return a maker of small networks in evaluation mode; keyword arguments change sections of the configuration."""

    def make(seed: int = 0, **sections: dict[str, object]) -> PredMapNet:
        torch.manual_seed(seed)
        return PredMapNet(small_config("lite", **sections)).eval()

    return make


@pytest.fixture
def network(make_network: Callable[..., PredMapNet]) -> PredMapNet:
    return make_network()


@pytest.fixture
def make_inputs(network: PredMapNet) -> Callable[..., FrameInputs]:
    """Return a maker of random frames; ``x`` moves the car forward, metres."""

    def make(batch: int = 1, seed: int = 0, x: float = 0.0) -> FrameInputs:
        generator = torch.Generator().manual_seed(seed)
        image = network.config.image
        pose = torch.eye(4, dtype=torch.float64).repeat(batch, 1, 1)
        pose[:, 0, 3] = 1000.0 + x
        return FrameInputs(
            images=torch.randn(batch, len(DEMO_RIG), 3, image.height, image.width, generator=generator),
            camera_valid=torch.ones(batch, len(DEMO_RIG), dtype=torch.bool),
            ego_to_global=pose,
            calibration=collate_calibrations([calibrate(DEMO_RIG, network.config)] * batch),
        )

    return make
