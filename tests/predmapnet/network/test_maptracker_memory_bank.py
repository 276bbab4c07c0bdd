"""The vector memory alone, over a stream with births, deaths, standing still and a bank that overflows."""

import re

import numpy as np
import pytest
import torch

from predmapnet.network.maptracker.motion_mlp import MotionMlp
from predmapnet.network.maptracker.vector_memory import empty_vector_memory, recall_queries, store_queries
from predmapnet.presets import preset
from tests.predmapnet.network.maptracker_reference import FOLDER, difference, load_reference, pose

BANK = FOLDER / "vector_memory_unit.npz"
EMBEDDING, CODE = 2e-4, 2e-6


@pytest.fixture(scope="module")
def expected():
    if not BANK.is_file():
        pytest.skip(f"no reference fixtures at {BANK}: set PREDMAPNET_REFERENCE")
    with np.load(BANK) as values:
        return dict(values)


@pytest.fixture(scope="module")
def motion():
    spec, width = load_reference().spec, preset("maptracker-nuscenes").decoder.width
    perceptron = MotionMlp(width, 2 * width)
    state = {}
    for name, tensor in perceptron.state_dict().items():
        official = f"query_propagate.fc.{name.removeprefix('perceptron.')}"
        state[name] = torch.from_numpy(spec.make_tensor(official, tensor.shape))
    perceptron.load_state_dict(state)
    return perceptron


@pytest.mark.reference
@torch.no_grad()
def test_entries_are_kept_chosen_and_carried_as_officially(expected, motion):
    reference, config = load_reference(), preset("maptracker-nuscenes")
    steps = 1 + max(int(name[1:].split("/")[0]) for name in expected if re.match(r"t\d+/", name))
    translations, rotations = reference.spec.unit_poses(steps)
    memory, ids, born_ever = empty_vector_memory(1, config, torch.device("cpu")), [], 0
    for step in range(steps):
        now = pose(rotations[step], translations[step])[None]
        frame = torch.tensor([step])
        values = {
            name.removeprefix(f"t{step}/"): value for name, value in expected.items() if name.startswith(f"t{step}/")
        }
        if step > 0:
            recalled = recall_queries(memory, motion, now, frame, config.decoder.memory_distances)
            entries = memory.valid[0].sum(dim=-1)
            first = memory.valid.shape[-1] - entries
            chosen = (recalled.slots[0] - first[:, None])[entries > recalled.slots.shape[-1]]
            assert difference(~recalled.valid[0], values, "key_padding_mask", reference.spec) == 0, step
            assert difference(chosen, values, "selected", reference.spec) == 0, step
            assert difference(recalled.code[0].transpose(0, 1), values, "pe", reference.spec) < CODE, step
            assert difference(recalled.queries[0].transpose(0, 1), values, "embeds", reference.spec) < EMBEDDING, step
        kept, born = reference.spec.unit_keep(step, ids)
        queries = torch.from_numpy(reference.spec.unit_hs(step, len(ids) + 100))
        rows = [*kept, *(len(ids) + index for index in born)]
        source = torch.tensor([[*kept, *(0 for _ in born)]])
        matched = torch.tensor([[*(True for _ in kept), *(False for _ in born)]])
        ids = [ids[index] for index in kept] + list(range(born_ever, born_ever + len(born)))
        born_ever += len(born)
        memory = store_queries(memory, queries[rows][None], source, matched, now, frame, torch.ones_like(matched))
        assert ids == values["active_ids_after"].tolist()
        lengths = np.minimum(values["entry_lengths_after"], config.decoder.memory_capacity)
        assert memory.valid[0].sum(dim=-1).tolist() == lengths.tolist(), step
