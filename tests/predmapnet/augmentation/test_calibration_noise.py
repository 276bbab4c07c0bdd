"""Wrong calibrations: small, seeded, and still those of cameras that turn about themselves."""

import numpy as np
import torch

from predmapnet.augmentation.calibration_noise import perturb_calibration
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate
from predmapnet.presets import preset

TRUE = calibrate(DEMO_RIG, preset("lite"))
ALWAYS = 1.0


def parts(projection):
    """Intrinsics, rotation and centre of a camera, from its projection matrix."""
    flip = np.eye(3)[::-1]
    lower, upper = np.linalg.qr((flip @ projection[:, :3]).T)
    intrinsics, rotation = flip @ upper.T @ flip, flip @ lower.T
    signs = np.diag(np.sign(np.diag(intrinsics)))
    return intrinsics @ signs, signs @ rotation, -np.linalg.solve(projection[:, :3], projection[:, 3])


def test_the_same_generator_gives_the_same_calibration():
    once, again = (perturb_calibration(TRUE, ALWAYS, np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(once.ego_to_image, again.ego_to_image)
    assert not torch.equal(once.ego_to_image, TRUE.ego_to_image)


def test_cameras_turn_about_a_degree_keep_their_optics_and_stay_where_they_are():
    turns = []
    for seed in range(60):
        wrong = perturb_calibration(TRUE, ALWAYS, np.random.default_rng(seed))
        for before, after in zip(TRUE.ego_to_image[0].numpy(), wrong.ego_to_image[0].numpy(), strict=True):
            (optics, rotation, centre), (new_optics, new_rotation, new_centre) = parts(before), parts(after)
            assert np.allclose(new_optics, optics, atol=1e-6)
            assert np.linalg.norm(new_centre - centre) < 0.3
            cosine = (np.trace(rotation.T @ new_rotation) - 1.0) / 2.0
            turns.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    assert 0.5 < np.mean(turns) < 1.5
    assert 1.0 < np.percentile(turns, 90) < 3.0


def test_as_many_calibrations_stay_right_as_asked_for():
    same = [perturb_calibration(TRUE, 0.5, np.random.default_rng(seed)) is TRUE for seed in range(200)]
    assert 0.35 < np.mean(same) < 0.65
