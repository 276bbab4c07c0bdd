"""Semantic-Aware Query Generator, Sec. 3.2: equations 1 to 3 and the masks M_L."""

import pytest
import torch

from predmapnet.network.instance_masks import MaskHead
from predmapnet.network.semantic_queries import SemanticAwareQueryGenerator
from tests.predmapnet.network.paper_network import (
    SIZES,
    attention_by_hand,
    bev_levels,
    cell_codes,
    opened,
    tiny_config,
)

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.parametrize("size", SIZES)]


def parts(config, seed=0):
    torch.manual_seed(seed)
    return opened(SemanticAwareQueryGenerator(config)), opened(MaskHead(config))


def paint_masks(head, config):
    """Let every query have the mask that the first channel of the mask features shows."""
    torch.nn.init.zeros_(head.embedding[-1].weight)
    torch.nn.init.zeros_(head.embedding[-1].bias)
    torch.nn.init.zeros_(head.bias)
    head.embedding[-1].bias.data[0] = 1.0
    rows, columns = config.mask_size
    features = torch.zeros(1, config.masks.channels, rows, columns)
    features[:, 0] = 0.0  # A probability of tau_L, and not above it.
    features[:, 0, 1:5, 2:9] = 5.0
    return features


def generate(generator, head, levels, features):
    return generator(levels[::-1], features, head)


def inside_of(features, level):
    """Cells of a level that touch the painted mask."""
    return torch.nn.functional.adaptive_max_pool2d(features[:, :1], level.shape[-2:])[0, 0] > 0


@torch.no_grad()
def test_cells_outside_the_mask_do_not_change_the_queries_and_cells_inside_do(size):
    config = tiny_config(size)
    generator, head = parts(config)
    features, levels = paint_masks(head, config), bev_levels(config)
    before = generate(generator, head, levels, features).queries
    for used in range(len(generator.level_inputs)):
        number = len(levels) - 1 - used
        inside = inside_of(features, levels[number])
        assert inside.any() and not inside.all()
        for where, matters in ((~inside, False), (inside, True)):
            changed = [level.clone() for level in levels]
            changed[number][:, :, where] += 7.0
            difference = (generate(generator, head, changed, features).queries - before).abs().max()
            assert bool(difference > 1e-3) == matters, f"level {number}"


@torch.no_grad()
def test_each_layer_attends_to_what_the_masks_of_the_layer_before_show(size):
    """Eq. 1 to 3, with Mask2Former's self-attention and perceptron, one query and one cell after the other."""
    config = tiny_config(size, semantic_queries={"layers": 3})
    generator, head = parts(config)
    levels = bev_levels(config)
    features = 3.0 * head.mask_features(levels)
    generated = generate(generator, head, levels, features)
    queries, position = generator.content, generator.position
    threshold = config.semantic_queries.mask_threshold
    some_mask = False
    for number, layer in enumerate(generator.layers):
        level = levels[::-1][number % 3]
        logits = head(queries[None], features)
        torch.testing.assert_close(logits, generated.masks[number], atol=1e-4, rtol=1e-4)
        mask = torch.nn.functional.adaptive_max_pool2d(logits, level.shape[-2:])[0].flatten(1).sigmoid() > threshold
        some_mask |= bool((mask.any(dim=1) & ~mask.all(dim=1)).any())
        mask[~mask.any(dim=1)] = True
        cells = generator.level_inputs[number % 3](level[0].flatten(1).T)
        places = generator.cell_code(cell_codes(*level.shape[-2:]))
        found = attention_by_hand(layer.cross_attention, queries + position, cells + places, cells, mask)
        queries = layer.cross_norm(queries + found)
        everyone = torch.ones(len(queries), len(queries), dtype=torch.bool)
        placed = queries + position
        queries = layer.self_norm(queries + attention_by_hand(layer.self_attention, placed, placed, queries, everyone))
        queries = layer.feed_forward.norm(queries + layer.feed_forward.perceptron(queries))
    assert some_mask
    torch.testing.assert_close(queries, generated.queries[0], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_masks_are_products_of_queries_and_bev_features_and_the_last_ones_are_of_the_last_queries(size):
    config = tiny_config(size)
    generator, head = parts(config)
    levels = bev_levels(config)
    features = head.mask_features(levels)
    level = levels[config.mask_level]
    projected = torch.einsum("bchw,mc->bmhw", level, head.features.weight.view(config.masks.channels, -1))
    torch.testing.assert_close(features, projected + head.features.bias[:, None, None], atol=1e-4, rtol=1e-4)
    generated = generate(generator, head, levels, features)
    assert len(generated.masks) == config.semantic_queries.layers + 1
    embedding = head.embedding(head.norm(generated.queries))
    by_hand = torch.einsum("bqm,bmhw->bqhw", embedding, features) + head.bias
    torch.testing.assert_close(generated.masks[-1], by_hand, atol=1e-4, rtol=1e-4)
    assert generated.masks[-1].shape == (1, config.decoder.queries, *config.mask_size), "one mask a query, of no class"


@torch.no_grad()
def test_a_surer_threshold_leaves_less_to_attend_to(size):
    """Logits of 1 mean 0.73: above tau_L = 0.5, below 0.9, where the mask is empty and all cells are attended to."""
    differences = []
    for threshold in (0.5, 0.9):
        config = tiny_config(size, semantic_queries={"mask_threshold": threshold})
        generator, head = parts(config)
        features, levels = paint_masks(head, config).clamp(max=1.0), bev_levels(config)
        before = generate(generator, head, levels, features).queries
        changed = [level.clone() for level in levels]
        changed[-1][:, :, ~inside_of(features, levels[-1])] += 7.0
        differences.append(float((generate(generator, head, changed, features).queries - before).abs().max()))
    assert differences[0] == 0.0 and differences[1] > 1e-3


@torch.no_grad()
def test_what_a_query_is_called_changes_neither_masks_nor_queries(size):
    config = tiny_config(size)
    generator, head = parts(config)
    levels = bev_levels(config)
    before = generate(generator, head, levels, head.mask_features(levels))
    if size == "paper":
        assert generator.classify is None and not before.logits, "class-agnostic"
        return
    torch.nn.init.normal_(generator.classify.weight, std=5.0)
    after = generate(generator, head, levels, head.mask_features(levels))
    assert torch.equal(before.queries, after.queries)
    assert all(torch.equal(one, other) for one, other in zip(before.masks, after.masks, strict=True))


@torch.no_grad()
def test_queries_know_the_scene_unless_the_generator_is_off(size):
    for enabled in (True, False):
        config = tiny_config(size, semantic_queries={"enabled": enabled})
        generator, head = parts(config)
        one, other = (
            generate(generator, head, levels, head.mask_features(levels)).queries
            for levels in (bev_levels(config, seed=1), bev_levels(config, seed=2))
        )
        assert torch.equal(one, other) == (not enabled)


@torch.no_grad()
def test_streams_of_a_batch_keep_to_themselves(size):
    config = tiny_config(size)
    generator, head = parts(config)
    levels = bev_levels(config, batch=2)
    both = generate(generator, head, levels, head.mask_features(levels)).queries
    second = [level[1:] for level in levels]
    alone = generate(generator, head, second, head.mask_features(second)).queries
    torch.testing.assert_close(both[1:], alone, atol=1e-5, rtol=1e-4)
