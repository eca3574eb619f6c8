"""Extends the local map in flight: tracked or lost frames enter, keyframes, submaps and the camera's state leave."""
