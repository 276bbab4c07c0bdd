"""The real street opens as it lies there, through the reader that everyone's logs take."""

import os
from pathlib import Path

import pytest

from mapfusion.elements import ElementKind, RegionOfInterest
from tests.real_roads.street import open_street


@pytest.mark.reference
def test_the_real_street_opens_and_its_lines_lie_in_view():
    root = Path(os.environ.get("PREDMAPNET_REFERENCE", Path(__file__).parents[3] / "shared/reference/public"))
    if not (root / "real_street").is_dir():
        pytest.skip(f"no real_street under {root}; set PREDMAPNET_REFERENCE")
    street = open_street(root / "real_street")
    assert len(street) == 80
    frame = street.frame(len(street) // 2)
    assert set(frame.images) == {camera.name for camera in frame.rig}
    truth = street.truth(frame.index, RegionOfInterest())
    assert truth is not None and {ElementKind.DIVIDER, ElementKind.BOUNDARY} <= set(truth.kinds.tolist())
    assert street.georeference is not None
