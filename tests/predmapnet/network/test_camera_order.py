"""Networks with a code for each camera take rigs by the names of their cameras."""

from dataclasses import replace

import pytest

from predmapnet.datasets.argoverse2_files import ARGOVERSE2_CAMERAS
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.errors import UserError
from predmapnet.network.rig_geometry import in_learned_order


def test_cameras_find_their_places_by_name():
    turned = DEMO_RIG[3:] + DEMO_RIG[:3]
    assert in_learned_order(turned, NUSCENES_CAMERAS, "w") == DEMO_RIG


@pytest.mark.parametrize(
    ("rig", "cameras", "says"),
    [
        (DEMO_RIG[:5], NUSCENES_CAMERAS, "this car lacks CAM_BACK_RIGHT. Use weights"),
        ((*DEMO_RIG, replace(DEMO_RIG[0], name="CAM_TOP")), NUSCENES_CAMERAS, "this car has CAM_TOP, which they do"),
        (DEMO_RIG, ARGOVERSE2_CAMERAS, "each of 7 cameras .*lacks ring_front_center.* and has CAM_FRONT"),
    ],
)
def test_other_cameras_are_refused_and_named(rig, cameras, says):
    with pytest.raises(UserError, match=says):
        in_learned_order(rig, cameras, "w")
