"""The network: one file for each part of Fig. 2 of the paper, put together in :mod:`predmapnet.network.predmapnet`.

From left to right, as the figure has them; where there are two, the first is the one of the preset ``lite``, the second
MapTracker's:

- image features: :mod:`.image_backbone`, or :mod:`.resnet` with :mod:`.feature_pyramid`; :mod:`.depth_head` in training
- BEV encoder: :mod:`.bev_encoder` on the look-up of :mod:`.view_transform`, or :mod:`.bevformer` on the pillars of
  :mod:`.camera_pillars`
- past BEV maps: :mod:`.temporal_bev`, or :mod:`.bev_history` with :mod:`.temporal_fusion`
- semantic segmentation of the ground: :mod:`.segmentation_head`
- Semantic-Aware Query Generator: :mod:`.semantic_queries`, with :mod:`.instance_masks` and :mod:`.bev_pyramid`
- query propagation: :mod:`.track_propagation`, with :mod:`.motion_mlp` and :mod:`.vector_memory` for MapTracker's
- History Rasterized Map Memory: :mod:`.history_memory`; History-Map Guidance: :mod:`.history_guidance`
- Short-Term Future Guidance: :mod:`.future_guidance`
- map decoder: :mod:`.map_decoder`, or :mod:`.maptracker_decoder`
- which rows live on: :mod:`.tracking` and :mod:`.revival`

What goes in and out, and the state between two frames, is in :mod:`.interface`.
"""
