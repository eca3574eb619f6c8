"""Images enter; pyramids, corners, descriptors, aligned templates, disparities and offsets of rows leave."""
