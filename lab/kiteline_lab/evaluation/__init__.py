"""Evaluation: estimates and ground truth go in, errors (ATE, RPE, precision, recall) come out."""
