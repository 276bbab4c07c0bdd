"""Lines of a training on the screen: short, and with the time that is left."""

import pytest

from predmapnet.training.metrics import shown
from predmapnet.training.run_checkpoint import Position

VALUES = {"lr": 1e-3, "loss": 12.345, "focal": 3.0, "norm": 4.0, "seconds_per_step": 0.756}


@pytest.mark.parametrize(
    ("progress", "seconds", "left"),
    [(0.25, 1200.0, "60 min"), (1.0, 1200.0, "0 min"), (0.01, 3600.0, "99 h")],
)
def test_it_says_how_long_a_stage_still_takes(progress, seconds, left):
    line = shown(VALUES, Position(stage="single", step=240, seconds=seconds), progress)
    assert line == f"single {progress:4.0%}  step 240  loss 12.35  0.76 s a step, {left} left of this stage"


def test_a_validation_tells_its_means_alone():
    figures = {"val_mAP": 0.5, "val_C-mAP": 0.25, "val_ped_crossing": 0.125, "val_ped_crossing@0.5": 0.1}
    line = shown(figures, Position(stage="temporal", step=7, seconds=60.0), 0.5)
    assert line == "temporal  50%  step 7  validated: mAP 0.500  C-mAP 0.250  ped_crossing 0.125"
