"""Names of MapTracker's state-dict entries in this package."""

from __future__ import annotations

import re

_RESNET, _NECK, _BEV = "backbone.img_backbone.", "backbone.img_neck.", "backbone.transformer."
_ENCODER, _DECODER = f"{_BEV}encoder.layers.*.", "head.transformer.decoder.layers.*."
_ENCODER_HERE, _DECODER_HERE = "bev_encoder.layers.*.", "map_decoder.layers.*."

RULES = {
    f"{_RESNET}conv1.": "image_backbone.resnet.stem.convolution.",
    f"{_RESNET}bn1.": "image_backbone.resnet.stem.norm.",
    f"{_RESNET}layer*.*.conv1.": "image_backbone.resnet.stages.*.*.reduce.convolution.",
    f"{_RESNET}layer*.*.bn1.": "image_backbone.resnet.stages.*.*.reduce.norm.",
    f"{_RESNET}layer*.*.conv2.conv_offset.": "image_backbone.resnet.stages.*.*.spatial.convolution.offsets.",
    f"{_RESNET}layer*.*.conv2_offset.": "image_backbone.resnet.stages.*.*.spatial.convolution.offsets.",
    f"{_RESNET}layer*.*.conv2.": "image_backbone.resnet.stages.*.*.spatial.convolution.",
    f"{_RESNET}layer*.*.bn2.": "image_backbone.resnet.stages.*.*.spatial.norm.",
    f"{_RESNET}layer*.*.conv3.": "image_backbone.resnet.stages.*.*.expand.convolution.",
    f"{_RESNET}layer*.*.bn3.": "image_backbone.resnet.stages.*.*.expand.norm.",
    f"{_RESNET}layer*.*.downsample.0.": "image_backbone.resnet.stages.*.*.shortcut.convolution.",
    f"{_RESNET}layer*.*.downsample.1.": "image_backbone.resnet.stages.*.*.shortcut.norm.",
    f"{_NECK}lateral_convs.*.conv.": "image_backbone.pyramid.lateral.*.convolution.",
    f"{_NECK}lateral_convs.*.bn.": "image_backbone.pyramid.lateral.*.norm.",
    f"{_NECK}fpn_convs.*.conv.": "image_backbone.pyramid.smooth.*.convolution.",
    f"{_NECK}fpn_convs.*.bn.": "image_backbone.pyramid.smooth.*.norm.",
    "backbone.bev_embedding.weight": "bev_encoder.queries",
    "backbone.positional_encoding.row_embed.weight": "bev_encoder.row_code",
    "backbone.positional_encoding.col_embed.weight": "bev_encoder.column_code",
    f"{_BEV}level_embeds": "bev_encoder.level_code",
    f"{_BEV}cams_embeds": "bev_encoder.camera_code",
    f"{_ENCODER}attentions.0.sampling_offsets.": f"{_ENCODER_HERE}self_attention.sampling_offsets.",
    f"{_ENCODER}attentions.0.attention_weights.": f"{_ENCODER_HERE}self_attention.attention_weights.",
    f"{_ENCODER}attentions.0.value_proj.": f"{_ENCODER_HERE}self_attention.value.",
    f"{_ENCODER}attentions.0.output_proj.": f"{_ENCODER_HERE}self_attention.output.",
    f"{_ENCODER}attentions.1.deformable_attention.sampling_offsets.": (
        f"{_ENCODER_HERE}image_attention.sampling_offsets."
    ),
    f"{_ENCODER}attentions.1.deformable_attention.attention_weights.": (
        f"{_ENCODER_HERE}image_attention.attention_weights."
    ),
    f"{_ENCODER}attentions.1.deformable_attention.value_proj.": f"{_ENCODER_HERE}image_attention.value.",
    f"{_ENCODER}attentions.1.output_proj.": f"{_ENCODER_HERE}image_attention.output.",
    f"{_ENCODER}ffns.0.layers.0.0.": f"{_ENCODER_HERE}perceptron.first.",
    f"{_ENCODER}ffns.0.layers.1.": f"{_ENCODER_HERE}perceptron.second.",
    f"{_ENCODER}norms.*.": f"{_ENCODER_HERE}norms.*.",
    f"{_BEV}encoder.temporal_mem_layers.*.conv_in.": f"{_ENCODER_HERE}fusion.mix.convolution.",
    f"{_BEV}encoder.temporal_mem_layers.*.bn.": f"{_ENCODER_HERE}fusion.mix.norm.",
    f"{_BEV}encoder.temporal_mem_layers.*.res_layer.0.conv1.": f"{_ENCODER_HERE}fusion.first.convolution.",
    f"{_BEV}encoder.temporal_mem_layers.*.res_layer.0.bn1.": f"{_ENCODER_HERE}fusion.first.norm.",
    f"{_BEV}encoder.temporal_mem_layers.*.res_layer.0.conv2.": f"{_ENCODER_HERE}fusion.second.convolution.",
    f"{_BEV}encoder.temporal_mem_layers.*.res_layer.0.bn2.": f"{_ENCODER_HERE}fusion.second.norm.",
    "seg_decoder.conv_in.": "segmentation_head.before.",
    "seg_decoder.conv_mid_layers.0.1.": "segmentation_head.after.",
    "seg_decoder.conv_out.": "segmentation_head.classify.",
    "query_propagate.fc.*.": "propagation.motion.perceptron.*.",
    "head.query_embedding.weight": "query_generator.content",
    "head.reference_points_embed.": "query_generator.first_guess.0.",
    "head.input_proj.": "map_decoder.input.",
    "head.cls_branches.0.": "map_decoder.classify.",
    "head.reg_branches.0.*.": "map_decoder.line.*.",
    f"{_DECODER}attentions.0.attn.": f"{_DECODER_HERE}self_attention.attention.",
    f"{_DECODER}attentions.1.sampling_offsets.": f"{_DECODER_HERE}bev_attention.sampling_offsets.",
    f"{_DECODER}attentions.1.attention_weights.": f"{_DECODER_HERE}bev_attention.attention_weights.",
    f"{_DECODER}attentions.1.value_proj.": f"{_DECODER_HERE}bev_attention.value.",
    f"{_DECODER}attentions.1.output_proj.": f"{_DECODER_HERE}bev_attention.output.",
    f"{_DECODER}attentions.2.attn.": f"{_DECODER_HERE}memory_attention.attention.",
    f"{_DECODER}ffns.0.layers.0.0.": f"{_DECODER_HERE}perceptron.first.",
    f"{_DECODER}ffns.0.layers.1.": f"{_DECODER_HERE}perceptron.second.",
    f"{_DECODER}norms.*.": f"{_DECODER_HERE}norms.*.",
}
"""Beginnings of official names and of names here; a ``*`` is a number and stays as it is, but for stages."""

FIRST_STAGE = 1
"""The official code counts the stages of the ResNet from one."""

_PATTERNS = [(re.compile(re.escape(there).replace(r"\*", r"(\d+)")), here) for there, here in RULES.items()]
_ALIAS = re.compile(r"head\.(cls|reg)_branches\.[1-9]\d*\.")


def name_here(official: str) -> str | None:
    """Return the name of an official entry here; None if no rule covers it.

    Example:
        >>> name_here("backbone.img_backbone.layer3.0.conv2.conv_offset.bias")
        'image_backbone.resnet.stages.2.0.spatial.convolution.offsets.bias'
    """
    for pattern, here in _PATTERNS:
        found = pattern.match(official)
        if found is None:
            continue
        numbers = list(found.groups())
        if here.startswith("image_backbone.resnet.stages."):
            numbers[0] = str(int(numbers[0]) - FIRST_STAGE)
        for number in numbers:
            here = here.replace("*", number, 1)
        return here + official[found.end() :]
    return None


def original_of_alias(official: str) -> str | None:
    """Return the entry of which this one is a repetition; None if it is none.

    All six decoder layers share one classifier and one polyline branch, which the official file holds six times.
    """
    return _ALIAS.sub(r"head.\1_branches.0.", official) if _ALIAS.match(official) else None
