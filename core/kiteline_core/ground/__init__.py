"""Ground segmentation: a disparity or depth image and the direction of gravity in, labels and a column scan out."""
