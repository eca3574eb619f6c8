"""The sparse map: agents' keyframes and landmarks enter, poses, positions and covisibility are read from it."""
