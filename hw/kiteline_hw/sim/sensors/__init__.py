"""The path and the world enter; the images, inertial samples and odometry that sensors would measure leave."""
