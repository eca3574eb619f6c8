"""Images enter; pyramids, corners, descriptors and aligned templates leave."""
