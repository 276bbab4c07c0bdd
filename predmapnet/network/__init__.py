"""The network: one file for each part of Fig. 2 of the paper, put together in :mod:`predmapnet.network.predmapnet`.

From left to right, as the figure has them; where there are two, the first is the one of the preset ``lite``, the second
MapTracker's:

- image features: :mod:`.small.backbone`, or :mod:`.maptracker.resnet`; :mod:`.depth_head` in training
- BEV encoder: :mod:`.small.bev_encoder` on the look-up of :mod:`.small.ground_lookup`, or :mod:`.maptracker.bevformer`
  on :mod:`.maptracker.reference_points`; both find the ground from the :mod:`.calibration` of each frame
- past BEV maps: :mod:`.small.residual_bev_memory`, or :mod:`.maptracker.bev_memory`
- semantic segmentation of the ground: :mod:`.segmentation_head`
- Semantic-Aware Query Generator: :mod:`.semantic_queries`, with :mod:`.instance_masks` and :mod:`.bev_pyramid`
- query propagation: :mod:`.track_propagation`, with :mod:`.maptracker.motion_mlp` and :mod:`.maptracker.vector_memory`
- History Rasterized Map Memory: :mod:`.history_memory`; History-Map Guidance: :mod:`.history_guidance`
- Short-Term Future Guidance: :mod:`.future_guidance`
- map decoder: :mod:`.small.decoder`, or :mod:`.maptracker.decoder`
- which tracks live on: :mod:`.track_selection` and :mod:`.revival`; what they bring along: :mod:`.former_tracks`

What goes in and out, and the state between two frames, is in :mod:`.state`.
"""
