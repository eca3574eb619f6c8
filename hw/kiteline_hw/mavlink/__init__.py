"""MAVLink to a flight controller: poses and tunnelled packets enter; its velocities, IMU samples and packets leave."""
