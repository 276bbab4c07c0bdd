"""The mapper on frames with image files: streams in turns, missing cameras, reports."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from predmapnet.datasets.images import read_image
from predmapnet.datasets.nuscenes_tables import NUSCENES_CAMERAS
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.errors import UserError
from predmapnet.mapper import Mapper
from predmapnet.network.calibration import calibrate
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import StreamState
from predmapnet.scenes import Frame
from tests.predmapnet.small_networks import small_config

SURE = {"tau_d": 0.05, "tau_t": 0.05, "report_threshold": 0.02}
LITE = small_config("lite", tracking=SURE)
PAPER = small_config("paper-nuscenes", bev={"rows": 13, "columns": 26, "cameras": NUSCENES_CAMERAS}, tracking=SURE)


@pytest.fixture(scope="module", params=[pytest.param(LITE, id="lite"), pytest.param(PAPER, id="paper")])
def mapper(request):
    torch.manual_seed(0)
    network = PredMapNet(request.param)
    for parameter in network.parameters():
        if parameter.abs().max() == 0:
            torch.nn.init.normal_(parameter, std=0.1)
    for name, parameter in network.map_decoder.named_parameters():
        if "classify" in name and parameter.ndim == 2:
            torch.nn.init.normal_(parameter, std=0.2)
    return Mapper(network)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of four frames."""
    folder = tmp_path_factory.mktemp("logs")
    return {name: [make_frame(folder, name, index, seed) for index in range(4)] for seed, name in enumerate("ab")}


def make_frame(folder, scene, index, seed):
    generator = np.random.default_rng([seed, index])
    images = {}
    for camera in DEMO_RIG:
        images[camera.name] = folder / f"{scene}-{index}-{camera.name}.png"
        small = generator.integers(0, 255, (9, 16, 3), dtype=np.uint8)
        cv2.imwrite(str(images[camera.name]), cv2.resize(small, (camera.width, camera.height)))
    pose = np.eye(4)
    pose[0, 3] = 500.0 + 2.0 * index
    return Frame(scene, index, f"{scene}{index}", 10**9 * index, pose, DEMO_RIG, images)


def same(one, other, tolerance=0.0):
    assert one.track_ids.tolist() == other.track_ids.tolist()
    np.testing.assert_allclose(one.scores, other.scores, rtol=0, atol=tolerance)
    np.testing.assert_allclose(np.array(one.polylines), np.array(other.polylines), rtol=0, atol=tolerance)
    np.testing.assert_allclose(one.history_masks, other.history_masks, rtol=0, atol=tolerance)


def run(mapper, frames):
    state, maps = None, []
    for frame in frames:
        frame_map, state = mapper.step(frame, state)
        maps.append(frame_map)
    return maps


def test_two_logs_in_turns_give_the_same_as_one_after_the_other(mapper, logs):
    apart = {name: run(mapper, frames) for name, frames in logs.items()}
    states = dict.fromkeys(logs)
    for index in range(4):
        for name, frames in logs.items():
            frame_map, states[name] = mapper.step(frames[index], states[name])
            same(frame_map, apart[name][index])
    assert len(apart["a"][-1].tracked) > 0


def test_a_saved_state_goes_on_as_if_nothing_had_happened(mapper, logs):
    maps = run(mapper, logs["a"])
    _, state = mapper.step(logs["a"][0], None)
    restored = StreamState.from_tensors({name: tensor.clone() for name, tensor in state.tensors().items()})
    same(mapper.step(logs["a"][1], restored)[0], maps[1])


def test_a_frame_map_holds_what_it_promises(mapper, logs):
    for frame, frame_map in zip(logs["a"], run(mapper, logs["a"]), strict=True):
        assert frame_map.timestamp == frame.timestamp
        assert (frame_map.scores >= 0).all() and (frame_map.scores <= 1).all()
        tracked = frame_map.track_ids >= 0
        assert len(set(frame_map.track_ids[tracked])) == tracked.sum()
        for kind, line, forecast, ours in zip(
            frame_map.kinds, frame_map.polylines, frame_map.forecasts, tracked, strict=True
        ):
            assert line.shape == (mapper.config.decoder.points, 2) and line.dtype == np.float64
            assert (np.abs(line) <= frame_map.roi.size / 2).all()
            assert len(forecast) == (mapper.config.decoder.points if ours else 0)
            if kind == 0:
                np.testing.assert_array_equal(line[0], line[-1])
        rows, columns = mapper.config.bev.rows, mapper.config.bev.columns
        assert frame_map.segmentation.shape == (3, 2 * rows, 2 * columns)
        assert frame_map.segmentation.dtype == np.float32
        assert frame_map.history_masks.shape == (len(frame_map), 13, 26)


def test_a_missing_camera_is_an_error_that_says_which_and_what_to_do(mapper, logs):
    frame = logs["a"][2]
    gone = frame.images["CAM_BACK"].with_name("gone.jpg")
    with pytest.raises(UserError) as caught:
        mapper.step(replace(frame, images={**frame.images, "CAM_BACK": gone}))
    for words in ("Frame 2 of a", "CAM_BACK", str(gone), "--allow-missing-cameras"):
        assert words in str(caught.value)
    absent = {name: path for name, path in frame.images.items() if name != "CAM_FRONT"}
    with pytest.raises(UserError, match="CAM_FRONT: the data set names no file"):
        mapper.step(replace(frame, images=absent))


def test_a_camera_that_may_be_missing_is_masked(mapper, logs):
    frame = logs["a"][0]
    absent = {name: path for name, path in frame.images.items() if name != "CAM_BACK"}
    images = mapper.read_images(replace(frame, images=absent), allow_missing_cameras=True)
    assert images.valid.tolist() == [True, True, True, False, True, True]
    seen, _ = mapper.step(frame)
    masked, _ = mapper.step(replace(frame, images=absent), allow_missing_cameras=True)
    assert np.abs(seen.segmentation - masked.segmentation).max() > 1e-4
    with pytest.raises(UserError, match="no image of any camera"):
        mapper.read_images(replace(frame, images={}), allow_missing_cameras=True)


@pytest.mark.parametrize("mapper", [pytest.param(PAPER, id="paper")], indirect=True)
def test_a_network_that_knows_its_cameras_by_name_takes_any_of_them_in_any_order(mapper, logs):
    frames = [replace(frame, rig=frame.rig[4:] + frame.rig[:4]) for frame in logs["a"][:2]]
    for ours, expected in zip(run(mapper, frames), run(mapper, logs["a"]), strict=False):
        same(ours, expected, tolerance=1e-3)
    fewer, _ = mapper.step(replace(frames[0], rig=DEMO_RIG[:5]))
    absent = {name: path for name, path in frames[0].images.items() if name != DEMO_RIG[5].name}
    masked, _ = mapper.step(replace(frames[0], images=absent), allow_missing_cameras=True)
    same(fewer, masked, tolerance=1e-3)
    with pytest.raises(UserError, match="this car has CAM_TOP"):
        mapper.step(
            replace(frames[0], rig=(replace(DEMO_RIG[0], name="CAM_TOP"),)), images=mapper.read_images(frames[0])
        )


def test_an_image_of_another_size_or_type_is_refused(mapper, logs, tmp_path):
    path, black = tmp_path / "small.png", np.zeros((450, 800, 3), np.uint8)
    cv2.imwrite(str(path), black[:90, :160])
    frame = logs["a"][0]
    for image, words in (
        (path, r"small\.png has 160 x 90 pixels.* 800 x 450"),
        (black[:90, :160], "CAM_FRONT has 160 x 90 pixels.* 800 x 450"),
        (black.astype(np.float32), "CAM_FRONT is float32"),
        (black[:, :, 0], "height, width, 3"),
    ):
        with pytest.raises(UserError, match=words):
            mapper.step(replace(frame, images={**frame.images, "CAM_FRONT": image}))


def test_pixels_give_the_same_as_their_files(mapper, logs):
    frames = [replace(frame, images={n: read_image(p) for n, p in frame.images.items()}) for frame in logs["a"][:2]]
    for ours, expected in zip(run(mapper, frames), run(mapper, logs["a"][:2]), strict=True):
        same(ours, expected)


def test_cameras_that_do_not_move_are_projected_once_and_others_anew(mapper):
    def geometry(metres):
        pose = DEMO_RIG[0].camera_to_ego.copy()
        pose[0, 3] += metres
        rig = (replace(DEMO_RIG[0], camera_to_ego=pose), *DEMO_RIG[1:])
        return mapper.engine._geometry(calibrate(rig, mapper.config))

    first = geometry(0.0)
    assert geometry(0.05) is not first
    assert geometry(0.0) is first
    for step in range(20):
        geometry(0.1 + 0.01 * step)
    assert len(mapper.engine._geometries) <= 8
    assert geometry(0.0) is not first


def test_an_unknown_device_is_refused():
    from predmapnet.mapper import choose_device

    with pytest.raises(UserError, match="There is no device 'toaster'"):
        choose_device("toaster")


def test_a_frame_that_was_seen_ahead_gives_the_same_and_only_the_rest_is_computed(mapper, logs):
    expected, state, calls = [], None, []
    absent = [replace(f, images={n: p for n, p in f.images.items() if n != "CAM_BACK"}) for f in logs["a"]]
    for frame in absent:
        frame_map, state = mapper.step(frame, state, allow_missing_cameras=True)
        expected.append(frame_map)
    seen = [mapper.see(frame, mapper.read_images(frame, allow_missing_cameras=True)) for frame in absent]
    hook = mapper.engine.network.image_backbone.register_forward_hook(lambda *_: calls.append(1))
    state = None
    for frame, ahead, ours in zip(absent, seen, expected, strict=True):
        frame_map, state = mapper.step(frame, state, images=ahead)
        same(frame_map, ours)
        assert np.array_equal(frame_map.visible[0], ours.visible[0])
    hook.remove()
    assert not calls
