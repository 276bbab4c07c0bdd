"""BEV features that are computed once are those of the scenes, the encoders and the hand that they are asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from predmapnet.augmentation.frames import load_frame
from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.frame_cache.prepare import DataOptions, DataSet
from predmapnet.frame_cache.scene_cache import CachedScene, TrainingScenes, frame_path, read_arrays, write_arrays
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.runs.train import RunOptions, run_stages
from predmapnet.training.data.batches import collate_frames
from predmapnet.training.features import fill_features
from predmapnet.training.loop import LoopSettings
from predmapnet.training.plan import PlanOptions
from tests.predmapnet.training.painted_scenes import painted_scene, tiny_config
from tests.predmapnet.training.small_runs import one_process, quiet

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG, FRAMES = tiny_config(), 4


@pytest.fixture
def scenes(tmp_path):
    return [painted_scene(tmp_path / "cache" / f"scene-{seed}", FRAMES, seed, CONFIG) for seed in range(4)]


def together(scenes, config=CONFIG):
    return TrainingScenes(scenes, [1.0] * len(scenes), config)


def some_network(seed=0, config=CONFIG):
    torch.manual_seed(seed)
    return PredMapNet(config).eval()


@torch.no_grad()
def encoded(network, scenes, scene, frame, mirrored):
    inputs = collate_frames([load_frame(scenes, scene, frame, mirrored)], network.config).inputs(network)
    return network.encode_bev(network.encode_images(inputs), inputs)


def agree(network, chosen, folder):
    """Whether the stored features of all frames are what the network computes for them."""
    scenes = together(chosen, network.config)
    store = fill_features(network, scenes, folder, 0, 1, quiet)
    found = []
    for scene in range(len(chosen)):
        for frame in range(len(chosen[scene])):
            stored = store.read(np.array([scene]), np.array([frame]))
            right = encoded(network, scenes, scene, frame, store.mirrored(scene))
            pairs = zip(stored.levels, right.levels, strict=True)
            found.append(all(torch.allclose(one, other, atol=2e-3, rtol=2e-3) for one, other in pairs))
    return all(found)


def test_other_scenes_other_weights_and_another_encoder_in_the_same_folder(scenes, tmp_path):
    network, folder = some_network(), tmp_path / "run"
    assert agree(network, scenes[:2], folder)
    assert agree(network, scenes[2:], folder), "other scenes at the same places"
    assert agree(network, scenes[1::-1], folder), "what was mirrored is not, and the other way round"
    assert agree(some_network(seed=1), scenes[:2], folder)
    lifted = {"bev": {**CONFIG.bev.model_dump(), "further_heights": (-0.4, 0.4)}}
    other = some_network(config=PredMapNetConfig.model_validate(CONFIG.model_dump() | lifted))
    assert agree(other, scenes[:2], folder)
    wider = some_network(config=PredMapNetConfig.model_validate(CONFIG.model_dump() | {"roi_width": 20.0}))
    wider.load_state_dict(network.state_dict(), strict=False)
    assert agree(wider, scenes[:2], folder), "no weight knows the region"


def test_a_frame_that_was_made_anew_has_new_features(scenes, tmp_path):
    network, path = some_network(), frame_path(scenes[0].folder, 2)
    assert agree(network, scenes[:1], tmp_path / "run")
    arrays = read_arrays(path)
    write_arrays(path, arrays | {"images": read_arrays(frame_path(scenes[1].folder, 3))["images"]})
    assert agree(network, [CachedScene(scenes[0].folder)], tmp_path / "run")
    path.unlink()
    with pytest.raises(UserError, match="damaged"):
        CachedScene(scenes[0].folder).digest()


def test_processes_share_the_scenes_even_if_one_is_ahead(scenes, tmp_path):
    network = some_network()
    for rank in range(2):
        store = fill_features(network, together(scenes), tmp_path / "run", rank, 2, quiet)
    assert all(store.has(scene) for scene in range(len(scenes)))


def test_a_stage_does_not_go_on_with_other_data(scenes, tmp_path):
    options = RunOptions(
        CONFIG,
        DataOptions((DataSet("demo"),), tmp_path),
        tmp_path / "run",
        plan=PlanOptions(batch=2, steps=3),
        loop=LoopSettings(checkpoint_minutes=0.0),
    )

    def go_on(chosen, **changes):
        again = replace(options, resume=(tmp_path / "run").exists(), **changes)
        return run_stages(one_process(), again, (together(chosen), []), quiet)

    assert go_on(scenes[:2], stage="single")
    assert go_on(scenes[2:], stage="temporal"), "a stage of its own may learn from others"
    for checkpoint in sorted((tmp_path / "run").glob("frames-*"))[1:]:
        position = checkpoint / "position.json"
        position.write_text(position.read_text().replace('"temporal"\n', "").replace('"single",\n', '"single"\n'))
    for chosen, changes in ((scenes[:2], {}), (scenes[2:], {"plan": PlanOptions(batch=4, steps=5)})):
        with pytest.raises(UserError, match=r"temporal .* begun with other data"):
            go_on(chosen, **changes)
    assert go_on(scenes[2:], plan=PlanOptions(batch=2, steps=3))
