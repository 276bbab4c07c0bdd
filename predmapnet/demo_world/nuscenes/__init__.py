"""The nuScenes schema, as the demo world writes it."""
