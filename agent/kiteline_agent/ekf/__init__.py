"""A Kalman filter over pose and landmarks. Odometry and tracked pixels enter, a pose and landmarks leave."""
