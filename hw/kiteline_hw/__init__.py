"""The edge of kiteline: cameras, data sets, logs, links, clocks. Knows nothing of SLAM."""
