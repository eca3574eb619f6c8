"""Measurements behind `kiteline bench`: the product flies on one harness, bars and docs/results.md leave."""
