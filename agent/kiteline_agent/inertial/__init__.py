"""IMU samples and poses from images enter; fused poses, velocity, biases and gravity leave."""
