"""Begins maps of a monocular camera: images or a metric scale enter, the landmarks of a first keyframe leave."""
