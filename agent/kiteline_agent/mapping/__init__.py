"""Extends the local map along the flight: tracked or lost frames enter, keyframes, submaps and the camera's state leave."""
