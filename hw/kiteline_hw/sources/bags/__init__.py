"""Bags of ROS 2: file paths enter, raw messages with their definitions leave."""
